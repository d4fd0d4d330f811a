"""What a loop does with its ports: read the modem, read the sensors, write the modem."""

import logging
import math
from collections import Counter, deque
from collections.abc import Callable, Iterator

from firmware.soundings import Odometry, Ping
from firmware.vehicle_core import Navigator
from protocol.modems.base import Modem, Reception

LOG = logging.getLogger(__name__)
SensorStep = tuple[Odometry, Ping | None]
_SAME_INSTANT_S = 1e-6
_FAR_AHEAD_S = 2.0  # no sensor measures so far ahead of our clock
_MOST_AHEAD = 64  # of them wait, a quarter of a minute of navigation; twice as many are looked at


class SensorPort:
    """Hands a core the sensors' steps as their times come.

    A step stamped far ahead of the clock waits like any other: it may be read in advance, or the
    clock was set back. But those after it are looked at: where one is stamped for now, the earlier
    ones were stamped wrongly. They are dropped and counted, and so are the oldest when too many
    wait. Of steps read in advance, which have no end, none is lost.
    """

    def __init__(self, steps: Iterator[SensorStep]) -> None:
        self._steps = steps
        self._waiting: deque[SensorStep] = deque()
        self.counters: Counter[str] = Counter()

    def feed(self, core: Navigator, now_s: float) -> None:
        """Give the core every step up to and including now."""
        while (step := self._next(now_s)) is not None:
            odometry, ping = step
            core.receive_odometry(odometry)
            if ping is not None:
                core.receive_ping(ping)

    def _next(self, now_s: float) -> SensorStep | None:
        waiting = self._waiting
        if not waiting or _is_after(waiting[0], now_s + _FAR_AHEAD_S):
            self._look_on(now_s)
        if not waiting or _is_after(waiting[0], now_s + _SAME_INSTANT_S):
            return None
        return waiting.popleft()

    def _look_on(self, now_s: float) -> None:
        """Take what the sensors have, up to a step for now; drop what it leaves behind."""
        while len(self._waiting) < 2 * _MOST_AHEAD:
            step = next(self._steps, None)
            if step is None:
                self._keep(_MOST_AHEAD)
                return
            is_near = not _is_after(step, now_s + _FAR_AHEAD_S)
            if is_near and math.isfinite(step[0].time_s):  # no time says nothing of others
                self._keep(0)
            self._waiting.append(step)
            if is_near:
                return

    def _keep(self, newest: int) -> None:
        while len(self._waiting) > newest:
            self._waiting.popleft()
            self.counters["steps_from_the_future"] += 1


def _is_after(step: SensorStep, time_s: float) -> bool:
    return step[0].time_s > time_s


class ModemPort:
    """Moves frames between a modem and a core, and counts what the link did meanwhile."""

    def __init__(self, modem: Modem, period_s: float = 0.25) -> None:
        self._modem, self._period_s = modem, period_s
        self.counters: Counter[str] = Counter()
        self.notices: deque[str] = deque(maxlen=20)  # for the status; older ones are in the log

    def hear(self, receive: Callable[[Reception], None], now_s: float) -> None:
        """Give every frame that came to the core."""
        self._modem.poll(now_s)
        while (event := self._modem.next_event()) is not None:
            if isinstance(event, Reception):
                receive(event)
            else:
                self.counters["link_notices"] += 1
                self.notices.append(event.text)
                LOG.warning("%.2f s: %s", event.at_s, event.text)

    def speak(
        self, poll: Callable[[float], bytes | None], now_s: float, late_s: float = 0.0
    ) -> None:
        """Send the core's frames of this instant, or of the second that a lead before it is now.

        late_s is what the loop's work has taken since this instant: the modem is told the time that
        it is, lest it load a packet for a second that has passed.

        A modem that loads its packets before they start is given them by the last period that is
        early enough: what the core then knows is newest.

        While the port is away the core is not asked: a frame that waits in a queue would leave
        with a time of transmission that is no longer true, and its range would be wrong.
        """
        start_s = now_s if self._modem.lead_s == 0.0 else self._start_s(now_s + late_s)
        if start_s is not None and self._modem.status().is_up:
            for _ in range(self._modem.frames_per_packet):
                frame = poll(start_s)
                if frame is None:
                    break
                self._modem.send(frame, now_s + late_s, start_s)
        self._modem.poll(now_s + late_s)

    def _start_s(self, now_s: float) -> float | None:
        """Return when a frame that is handed over now would start; None: a later one does too."""
        earliest_s = now_s + self._modem.lead_s
        start_s = float(math.ceil(earliest_s - _SAME_INSTANT_S))
        return start_s if start_s - earliest_s < self._period_s - _SAME_INSTANT_S else None

    def status(self) -> dict[str, int]:
        """Return the link's counters."""
        status = self._modem.status()
        return {
            **self.counters,
            **{f"modem_{name}": count for name, count in status.errors.items()},
            "modem_sent": status.sent,
            "modem_received": status.received,
            "modem_queued": status.queued,
            "modem_dropped": status.dropped_in + status.dropped_out,
            "modem_discarded": status.discarded,
            "modem_reopened": status.reopened,
        }
