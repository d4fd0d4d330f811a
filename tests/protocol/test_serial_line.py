"""The raw serial line on ptys: ports that are missing, vanish, come back; foreign traffic."""

import os
import termios
import time
import tty
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import MagicMock

import pytest

from protocol.codec import decode, encode
from protocol.errors import ConfigError, ModemUnavailable, RemoteProtocolError
from protocol.framing import LineReader, wrap
from protocol.modems.base import QUEUED_FRAMES, LinkNotice, Reception
from protocol.modems.port import REOPEN_S
from protocol.modems.registry import DIALECTS, open_modem
from protocol.modems.serial_line import SerialLineModem
from tests.protocol.strategies import paper_packet


class Port:
    """A serial port that can be pulled: a link to a pty, as udev keeps one to an adapter."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.master = -1

    def plug(self) -> None:
        self.master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self.master, False)
        self.path.symlink_to(os.ttyname(slave))
        os.close(slave)

    def pull(self) -> None:
        self.path.unlink(missing_ok=True)
        if self.master >= 0:
            os.close(self.master)
        self.master = -1

    def read(self) -> bytes:
        try:
            return os.read(self.master, 65536)
        except (BlockingIOError, OSError):
            return b""

    def read_whole(self, expected: bytes) -> bytes:
        """Read until as many bytes came as are expected: the kernel passes them on in its time."""
        data = b""
        for _ in range(1000):
            data += self.read()
            if len(data) >= len(expected):
                break
            time.sleep(0.001)
        return data


@pytest.fixture
def port(tmp_path: Path) -> Iterator[Port]:
    port = Port(tmp_path / "modem")
    port.plug()
    yield port
    port.pull()


def open_line(port: Port) -> SerialLineModem:
    modem = open_modem(f"serial://{port.path}?baud=19200")
    assert isinstance(modem, SerialLineModem)
    return modem


def write_and_poll(port: Port, modem: SerialLineModem, data: bytes, now_s: float = 0.0) -> None:
    """Write to the modem's port and poll until the kernel has passed all of it on."""
    before = modem.bytes_read
    os.write(port.master, data)
    for _ in range(1000):
        modem.poll(now_s)
        if modem.bytes_read == before + len(data):
            return
        time.sleep(0.001)
    raise AssertionError("the pty did not pass the bytes on")


def received(modem: SerialLineModem) -> list[bytes]:
    frames = []
    while (event := modem.next_event()) is not None:
        if isinstance(event, Reception):
            frames.append(event.frame)
    return frames


def test_a_port_that_is_not_there_is_one_line_that_says_what_to_do() -> None:
    with pytest.raises(ModemUnavailable, match="/dev/nowhere is not there; plug"):
        open_modem("serial:///dev/nowhere")


def test_a_file_that_is_no_port_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"")
    with pytest.raises(ModemUnavailable, match="cannot be opened as a serial port"):
        open_modem(f"serial://{path}")


def test_an_unknown_scheme_names_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"no modem dialect 'janus'; known are loopback://"):
        open_modem("janus:///dev/ttyUSB0")


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("/dev/ttyUSB0", "is no URL; write e.g."),
        ("serial://", "names no port"),
        ("serial:///dev/ttyUSB0?bauds=9600", "unknown option 'bauds'; known are baud"),
        ("serial:///dev/ttyUSB0?baud=fast", "baud is 'fast'; give a whole number"),
        ("serial:///dev/ptmx?baud=-5", "baud is -5; give 300 to 4000000"),
        ("serial:///dev/ptmx?baud=99999999999999999999", "give 300 to 4000000"),
        ("serial://[x", "is no URL; write e.g."),
        ("loopback://?node=1", "works inside one process only"),
    ],
)
def test_a_wrong_url_is_one_line_that_says_what_would_be_right(url: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        open_modem(url)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("scheme", sorted(DIALECTS))
def test_every_dialect_in_the_registry_can_be_imported(scheme: str) -> None:
    with pytest.raises((ConfigError, ModemUnavailable)):
        open_modem(f"{scheme}:///dev/nowhere?no_such_option=1")


def test_half_frames_garbage_and_foreign_traffic_cost_only_themselves(port: Port) -> None:
    modem = open_line(port)
    frame = encode(paper_packet())
    noise = b"$CAREV,030303,AUV,2.0.27087*16\r\n" + wrap(frame)[:100] + bytes(range(256))
    write_and_poll(port, modem, noise + wrap(frame))
    frames = received(modem)
    assert frames[-1] == frame
    for other in frames[:-1]:
        with pytest.raises(RemoteProtocolError):
            decode(other)
    assert modem.status().discarded >= 1
    modem.close()


def test_a_port_that_vanishes_and_comes_back_loses_nothing_queued(port: Port) -> None:
    modem = open_line(port)
    port.pull()
    modem.poll(1.0)
    assert not modem.status().is_up
    notice = modem.next_event()
    assert isinstance(notice, LinkNotice)
    assert "has gone" in notice.text
    sent = [bytes([i, 7]) for i in range(10)]
    for frame in sent:
        modem.send(frame, 2.0)
    port.plug()
    modem.poll(2.0 + REOPEN_S)
    line = b"".join(map(wrap, sent))
    assert port.read_whole(line) == line
    status = modem.status()
    assert (status.is_up, status.reopened, status.sent, status.queued) == (True, 1, 10, 0)
    modem.close()


def test_a_port_that_goes_while_it_is_opened_is_one_that_is_not_there(
    port: Port, monkeypatch: pytest.MonkeyPatch
) -> None:
    modem = open_line(port)
    port.pull()
    modem.poll(0.0)
    port.plug()
    with monkeypatch.context() as patch:
        patch.setattr(termios, "tcflush", MagicMock(side_effect=termios.error(5, "I/O error")))
        with pytest.raises(ModemUnavailable, match="I/O error"):
            open_line(port)
        modem.poll(REOPEN_S)
        assert not modem.status().is_up
    modem.poll(2 * REOPEN_S)
    assert modem.status().is_up
    modem.close()


def test_a_port_that_cannot_even_be_closed_comes_back(port: Port) -> None:
    modem = open_line(port)
    os.close(modem._port._serial.fileno())  # type: ignore[union-attr]
    modem.poll(0.0)
    assert not modem.status().is_up
    modem.poll(REOPEN_S)
    assert modem.status().is_up
    modem.close()


def test_a_hundred_pulls_are_survived(port: Port) -> None:
    modem = open_line(port)
    now_s, heard = 0.0, 0
    for i in range(100):
        port.pull()
        modem.poll(now_s)
        modem.send(bytes([i, 1]), now_s)
        port.plug()
        now_s += REOPEN_S
        modem.poll(now_s)
        assert port.read_whole(wrap(bytes([i, 1]))) == wrap(bytes([i, 1]))
        write_and_poll(port, modem, wrap(b"back"), now_s)
        heard += len(received(modem))
    assert (heard, modem.status().reopened) == (100, 100)
    modem.close()


def test_a_port_is_not_hammered_while_it_is_away(port: Port) -> None:
    modem = open_line(port)
    port.pull()
    modem.poll(0.0)
    port.plug()
    modem.poll(REOPEN_S / 2)
    assert not modem.status().is_up
    modem.poll(REOPEN_S)
    assert modem.status().is_up
    modem.close()


def test_the_queue_is_bounded_and_drops_the_oldest(port: Port) -> None:
    modem = open_line(port)
    port.pull()
    modem.poll(0.0)
    for i in range(QUEUED_FRAMES + 3):
        modem.send(bytes([i, 1]), 0.0)
    assert modem.status().queued == QUEUED_FRAMES
    assert modem.status().dropped_out == 3
    port.plug()
    modem.poll(REOPEN_S)
    line = b"".join(wrap(bytes([i, 1])) for i in range(3, QUEUED_FRAMES + 3))
    assert port.read_whole(line) == line
    modem.close()


def test_a_full_line_is_written_in_pieces_without_blocking(port: Port) -> None:
    modem = open_line(port)
    sent = [bytes([i]) * 256 for i in range(1, QUEUED_FRAMES + 1)]
    for frame in sent:
        modem.send(frame, 0.0)
    line = b""
    for _ in range(1000):
        modem.poll(0.0)
        line += port.read()
        if modem.status().queued == 0 and len(line) >= sum(len(wrap(f)) for f in sent):
            break
        time.sleep(0.001)
    assert line == b"".join(map(wrap, sent))
    modem.close()


def test_a_frame_that_the_line_takes_too_late_for_its_second_is_dropped(port: Port) -> None:
    modem, number = open_line(port), 0
    while not modem.status().queued:  # the peer does not read
        modem.send(number.to_bytes(2) + bytes(254), 1.0, 1.0)
        number += 1
    modem.send(b"some time", 1.0)
    for now_s in (1.25, 60.0):
        modem.poll(now_s)
    assert modem.status().dropped_out == 1
    modem.send(b"in time", 60.0, 60.0)
    reader, came = LineReader(), [b""]
    for _ in range(1000):
        modem.poll(60.25)
        reader.receive_data(port.read())
        while (heard := reader.next_frame()) is not None:
            came.append(heard.frame)
        if came[-1] == b"in time":
            break
        time.sleep(0.001)
    assert came[-2:] == [b"some time", b"in time"]
    assert len(came) < number  # what the system held is gone as well
    modem.close()


def test_raw_bytes_of_both_directions_can_be_tapped(port: Port) -> None:
    tapped: list[tuple[str, bytes, float]] = []
    modem = SerialLineModem(str(port.path), 19_200, lambda *args: tapped.append(args))
    modem.send(b"out", 1.0)
    write_and_poll(port, modem, b"raw in", 2.0)
    assert tapped == [("out", wrap(b"out"), 1.0), ("in", b"raw in", 2.0)]
    modem.close()
