"""Emulated modems between vehicles' processes, instead of raw lines: the water is beyond them."""

import itertools
import time
from collections.abc import Callable
from dataclasses import replace

from host_tools.emulators.bench import Bench, Unit
from host_tools.emulators.micromodem import MicroModemUnit
from host_tools.emulators.nanomodem import NanomodemUnit
from host_tools.emulators.ptys import PseudoPort
from host_tools.mission import Progress
from host_tools.mission_settings import MissionSettings, check_air
from host_tools.processes.control import Advance, Done
from host_tools.processes.remote_node import RemoteNode
from protocol.acoustics import Delivery, Water
from protocol.modems.dialect_driver import check_frame_size
from protocol.modems.micromodem_settings import FRAMES_AND_BYTES
from protocol.modems.nanomodem import ENVELOPE_BYTES
from protocol.modems.nanomodem import FRAME_BYTES as NANOMODEM_FRAME_BYTES
from protocol.packets import FRAME_BYTES

MODEMS: dict[str, tuple[str, ...]] = {
    "raw": (),
    "micromodem": (
        "slots.follower_slot_s=8",
        "slots.frames_per_slot=2",
        "slots.leader_period_s=40",
        "slots.leader_offsets_s=5,13,21,29",
    ),
    "nanomodem": (
        "follower.compression.small_frames=true",
        "slots.leader_offsets_s=2,10",
    ),
}
"""What is at the ports, and what it needs: slots for pairs of frames that sound for three seconds;
or frames of 62 bytes, 1.1 s long, and answers of 0.6 s between them, clear of each other to 1.2 km.
"""
_BAUD = {"micromodem": 19_200, "nanomodem": 9_600}
_LARGEST_FRAME_BYTES = {"micromodem": FRAME_BYTES, "nanomodem": NANOMODEM_FRAME_BYTES}
HANDOVER_S = 2.0
"""Of real time: a kernel that has not passed bytes on by then has lost them."""
NAP_S = 0.0001


def check_frames(kind: str, settings: MissionSettings) -> None:
    """Raise ConfigError when frames do not fit what is at the ports, or their slots."""
    if kind == "raw":
        check_air(settings)
        return
    follower = settings.follower
    check_frame_size(_LARGEST_FRAME_BYTES[kind], follower.frame_bytes, follower.profile)


def address_of(vehicle: int) -> int:
    """Return the modem address of a vehicle: 0 is broadcast."""
    return vehicle + 1


class EmulatedModems:
    """A modem for each vehicle in one water, on the bench that runs them."""

    def __init__(self, kind: str, water: Water, record: Callable[[Delivery], None]) -> None:
        self.scheme, self.baud = kind, _BAUD[kind]
        make: Callable[[int], Unit] = MicroModemUnit if kind == "micromodem" else NanomodemUnit
        units = {vehicle: make(address_of(vehicle)) for vehicle in water.nodes}
        envelope_bytes = 0 if kind == "micromodem" else ENVELOPE_BYTES
        self.bench = Bench(water, units, lambda one: _each_frame(one, envelope_bytes, record))

    def run(
        self,
        nodes: dict[int, RemoteNode],
        *,
        duration_s: float,
        tick_s: float,
        progress: Progress,
    ) -> None:
        """Drive all processes to the end; between two periods the modems do what they do."""
        for step in itertools.count():
            now_s = step * tick_s
            if now_s > duration_s + 1e-9:
                break
            self.bench.advance(now_s)
            for node in nodes.values():
                node.tick(now_s)
            progress(now_s)
        self.bench.end()


class ModemNode(RemoteNode):
    """A vehicle's process behind an emulated modem: bytes cross the port, whole, every period."""

    def __init__(
        self,
        vehicle: int,
        port: PseudoPort,
        advance: Callable[[float], None],
        until_answered: Callable[[RemoteNode], None],
        unit: Unit,
    ) -> None:
        super().__init__(vehicle, port, advance, until_answered, lambda: False)
        self._unit, self._read_bytes, self._written_bytes = unit, 0, 0

    def answer(self, done: Done) -> None:
        """Take the process's word on its period, and its bytes to the modem."""
        self._written_bytes = done.line_bytes
        super().answer(done)

    def _read(self, announced: list[int]) -> None:  # noqa: ARG002
        """Take as many bytes as the process has written, and let the modem have them.

        What has not come by then went with a port that was pulled.
        """
        wanted = self._written_bytes - self._read_bytes
        _wait(lambda: self.port.fileno is None or self.port.waiting_bytes()[1] >= wanted)
        data = self.port.read()
        self._read_bytes = self._written_bytes
        if data:
            self._unit.receive_data(data, self.now_s)

    def leave(self) -> None:
        """Let the process go; the next one counts its bytes from nothing."""
        super().leave()
        self._read_bytes = 0

    def _tell(self) -> None:
        if self.line is None:
            return
        data = self._unit.poll(self.now_s)
        before = self.port.waiting_bytes()[0] - self.port.written_bytes
        self.port.write(data)
        _wait(lambda: self.port.waiting_bytes()[0] - self.port.written_bytes >= before)
        self.line.send(Advance(now_s=self.now_s, in_real_time=self.in_real_time))


def _wait(condition: Callable[[], bool]) -> None:
    end_s = time.monotonic() + HANDOVER_S
    while not condition() and time.monotonic() < end_s:
        time.sleep(NAP_S)


def _each_frame(
    delivery: Delivery, envelope_bytes: int, record: Callable[[Delivery], None]
) -> None:
    """Record a packet without what its driver puts before a frame, 256-byte frames one by one."""
    size = FRAMES_AND_BYTES[4][1]
    whole = delivery.frame if delivery.sent is None else delivery.sent
    for k in range(envelope_bytes, len(whole), size):
        part = slice(k, k + size)
        record(replace(delivery, frame=delivery.frame[part], sent=whole[part]))
