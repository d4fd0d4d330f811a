"""A vehicle in a process of its own, as the mission's clock drives it."""

import select
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass

from host_tools.emulators.ptys import PseudoPort
from host_tools.nodes import BeliefLog
from host_tools.processes.control import Advance, Arrival, ControlLine, Done
from protocol.crc import crc32c
from protocol.framing import LineReader, wrap
from protocol.modems.base import QUEUED_EVENTS, QUEUED_FRAMES
from protocol.vehicles import name_of

HANDOVER_S = 2.0
"""Of real time: a kernel that has not passed bytes on by then has lost them."""
MOST_TRIES = 8
"""How often an arrival is put on a disturbed line before it counts as lost."""


@dataclass(slots=True)
class _Waiting:
    """An arrival that the vehicle has not confirmed."""

    arrival: Arrival
    frame: bytes
    tries: int = 0


class RemoteNode:
    """Speaks with one vehicle's process over its modem line and its control line.

    Nothing that was heard is forgotten before the process has found it on its line: while the
    port is pulled or the process is down it waits here, up to a cap, as in a modem's memory.
    """

    def __init__(
        self,
        vehicle: int,
        port: PseudoPort,
        advance: Callable[[float], None],
        until_answered: Callable[["RemoteNode"], None],
        is_air_free: Callable[[], bool],
    ) -> None:
        self.vehicle, self.port = vehicle, port
        self.line: ControlLine | None = None
        self.log = BeliefLog()
        self.counters: Counter[str] = Counter()
        self.now_s = self._present_s = 0.0
        self.is_answered = True
        self.in_real_time = False
        self._advance, self._until_answered, self._is_air_free = (
            advance,
            until_answered,
            is_air_free,
        )
        self._reader = LineReader()
        self._heard: deque[_Waiting] = deque(maxlen=QUEUED_EVENTS)
        self._told: list[_Waiting] = []
        self._to_send: deque[bytes] = deque(maxlen=QUEUED_FRAMES)

    @property
    def name(self) -> str:
        """The vehicle's name in messages and files."""
        return name_of(self.vehicle)

    def hear(self, frame: bytes, toa_s: float | None, now_s: float) -> None:
        """Take a frame from the water; it goes over the line with the next period."""
        arrival = Arrival(crc=crc32c(frame), toa_s=toa_s, heard_s=now_s)
        self.counters["arrivals_overwritten"] += len(self._heard) == self._heard.maxlen
        self._heard.append(_Waiting(arrival, frame))

    def tick(self, now_s: float) -> bytes | None:
        """Let the process run one period; return the frame that its modem transmits now."""
        self._advance(now_s)
        self._until_answered(self)
        if self._to_send and self._is_air_free():
            return self._to_send.popleft()
        return None

    def begin(self, now_s: float) -> None:
        """Serve the time to the process, if it is there and has answered the last one.

        One that comes back is served the time that it is then.
        """
        self._present_s = now_s
        if not self.is_answered:
            self.counters["periods_missed"] += 1
            if self.line is None:
                self.now_s = now_s
            return
        self.now_s, self.is_answered = now_s, False
        if self.line is not None:
            self._tell()

    def join(self, line: ControlLine) -> None:
        """Take the process that speaks over a line; what it was to hear is said (again)."""
        self.counters["joined"] += 1
        self.line = line
        self._heard.extendleft(reversed(self._told))
        self._told = []
        if not self.is_answered:
            self._tell()

    def leave(self) -> None:
        """Let the process go: its lines are cut."""
        if self.line is not None:
            self.line.close()
        self.line = None
        self._reader.reset()

    def answer(self, done: Done) -> None:
        """Take the process's word on its period, and its frames from the modem line."""
        if done.now_s != self.now_s or self.is_answered:
            self.counters["stray_answers"] += 1
            return
        self.is_answered = True
        self._keep_missed(list(done.missed))
        self._read(list(done.frames))

    def _tell(self) -> None:
        if self.line is None:
            return
        if self.port.fileno is not None:
            self._told = list(self._heard)
            self._heard.clear()
        for waiting in self._told:
            waiting.tries += 1
            self.port.write(wrap(waiting.frame))
        arrivals = tuple(waiting.arrival for waiting in self._told)
        self.line.send(Advance(now_s=self.now_s, arrivals=arrivals, in_real_time=self.in_real_time))

    def _keep_missed(self, missed: list[int]) -> None:
        again = []
        for waiting in self._told:
            if waiting.arrival.crc in missed:
                missed.remove(waiting.arrival.crc)
                if waiting.tries < MOST_TRIES:
                    again.append(waiting)
                    self.counters["arrivals_repeated"] += 1
                else:
                    self.counters["arrivals_lost_on_line"] += 1
        self._heard.extendleft(reversed(again))
        self._told = []

    def _read(self, announced: list[int]) -> None:
        """Take the announced frames from the line; all else on it is noise, and counted.

        A frame of a period that is over would leave after the second that it is stamped with, and
        give a wrong range: it is dropped.
        """
        is_late = self._present_s > self.now_s
        while True:
            self._reader.receive_data(self.port.read())
            while (heard := self._reader.next_frame()) is not None:
                crc = crc32c(heard.frame)
                if crc in announced:
                    announced.remove(crc)
                    if is_late:
                        self.counters["frames_late"] += 1
                        continue
                    self.counters["frames_overwritten"] += len(self._to_send) == QUEUED_FRAMES
                    self._to_send.append(heard.frame)
                else:
                    self.counters["foreign_frames"] += 1
            fileno = self.port.fileno
            if not announced or fileno is None:
                break
            if not select.select([fileno], [], [], HANDOVER_S)[0]:
                break
        self.counters["frames_lost_on_line"] += len(announced)

    def status(self) -> dict[str, int]:
        """Return the counters of both lines."""
        return {
            **{name: count for name, count in self.counters.items() if count},
            "line_discarded": self._reader.bad_frames + self._reader.overlong,
            "line_lost_bytes": self.port.lost_bytes,
        }
