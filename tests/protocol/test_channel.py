"""One channel test class over loopback, a serial pair, a byte at a time, lossy and delayed."""

import contextlib
import os
import time
import tty
from collections.abc import Iterator
from typing import Protocol

import numpy as np
import pytest

from protocol.acoustics import Water, WaterSettings
from protocol.framing import LineReader, wrap
from protocol.modems.base import LinkNotice, Modem, ModemContext, Reception
from protocol.modems.loopback import LoopbackMedium
from protocol.modems.registry import open_modem


class Channel(Protocol):
    """Two ends, and a clock that can be moved."""

    loses: bool

    def send(self, frame: bytes) -> None: ...

    def run(self, seconds: float) -> list[bytes]: ...


class LoopbackChannel:
    def __init__(self, settings: WaterSettings, range_m: float = 300.0) -> None:
        self.loses = settings.loss > 0.0
        water = Water(
            settings, np.random.default_rng(1), lambda node, _: (range_m * node, 0.0, 0.0)
        )
        context = ModemContext(medium=LoopbackMedium(water))
        self._a = open_modem("loopback://?node=0", context)
        self._b = open_modem("loopback://?node=1", context)
        self._now_s = 0.0

    def send(self, frame: bytes) -> None:
        self._a.send(frame, self._now_s)

    def run(self, seconds: float) -> list[bytes]:
        for _ in range(round(10 * seconds)):
            self._now_s += 0.1
            self._a.poll(self._now_s)
            self._b.poll(self._now_s)
        return heard(self._b)


class ByteAtATimeChannel:
    loses = False

    def __init__(self) -> None:
        self._reader = LineReader()

    def send(self, frame: bytes) -> None:
        for byte in wrap(frame):
            self._reader.receive_data(bytes([byte]))

    def run(self, seconds: float) -> list[bytes]:  # noqa: ARG002
        frames = []
        while (line_frame := self._reader.next_frame()) is not None:
            frames.append(line_frame.frame)
        return frames


class SerialPairChannel:
    """A serial line modem on a pty, whose other end echoes the line to a second pty."""

    loses = False

    def __init__(self) -> None:
        self.masters, slaves = zip(*(os.openpty() for _ in range(2)), strict=True)
        for slave in slaves:
            tty.setraw(slave)
        urls = [f"serial://{os.ttyname(slave)}" for slave in slaves]
        for slave in slaves:
            os.close(slave)
        for master in self.masters:
            os.set_blocking(master, False)
        self._a, self._b = (open_modem(url) for url in urls)

    def send(self, frame: bytes) -> None:
        self._a.send(frame, 0.0)

    def run(self, seconds: float) -> list[bytes]:
        frames: list[bytes] = []
        between = b""
        for step in range(round(20 * seconds)):
            self._a.poll(float(step))
            with contextlib.suppress(BlockingIOError):
                between += os.read(self.masters[0], 4096)
            with contextlib.suppress(BlockingIOError):
                between = between[os.write(self.masters[1], between) :]
            self._b.poll(float(step))
            frames += heard(self._b)
            time.sleep(0.0005)  # the kernel passes bytes on in its time
        return frames

    def close(self) -> None:
        self._a.close()
        self._b.close()
        for master in self.masters:
            os.close(master)


def heard(modem: Modem) -> list[bytes]:
    frames = []
    while (event := modem.next_event()) is not None:
        if isinstance(event, Reception):
            frames.append(event.frame)
        else:
            assert isinstance(event, LinkNotice)
    return frames


@pytest.fixture(params=["loopback", "byte-at-a-time", "serial-pair", "lossy", "delayed"])
def channel(request: pytest.FixtureRequest) -> Iterator[Channel]:
    if request.param == "serial-pair":
        pair = SerialPairChannel()
        yield pair
        pair.close()
    elif request.param == "byte-at-a-time":
        yield ByteAtATimeChannel()
    elif request.param == "lossy":
        yield LoopbackChannel(WaterSettings(loss=0.3, outlier_share=0.0))
    elif request.param == "delayed":
        yield LoopbackChannel(WaterSettings(loss=0.0, outlier_share=0.0), range_m=9_000.0)
    else:
        yield LoopbackChannel(WaterSettings(loss=0.0))


class TestChannel:
    def test_frames_arrive_whole_and_in_order(self, channel: Channel) -> None:
        sent = [bytes([i]) * 60 for i in range(20)]
        for frame in sent:
            channel.send(frame)
        arrived = channel.run(30.0)
        assert arrived == [frame for frame in sent if frame in arrived]
        assert arrived == sent or channel.loses

    def test_all_byte_values_pass(self, channel: Channel) -> None:
        sent = [bytes(range(256)), bytes(256), b"\xff" * 256]
        for frame in sent * 4:
            channel.send(frame)
        arrived = channel.run(60.0)
        assert set(arrived) <= set(sent)
        assert set(arrived) == set(sent)

    def test_nothing_sent_is_nothing_heard(self, channel: Channel) -> None:
        assert channel.run(1.0) == []
