"""The follower's loop: one thread, a cyclic executive between sensors, core and modem."""

from collections.abc import Callable, Iterator

from firmware.executive import Executive, Task
from firmware.follower.core import FollowerCore
from firmware.ports import ModemPort, SensorPort, SensorStep
from protocol.modems.base import Modem, Reception


class FollowerLoop:
    """Reads ports, runs the core, writes ports; `step` is called once a period of the clock.

    stopwatch returns the seconds by which deadlines are judged; in virtual time it stands still.
    """

    def __init__(
        self,
        core: FollowerCore,
        modem: Modem,
        steps: Iterator[SensorStep],
        stopwatch: Callable[[], float],
        period_s: float = 0.25,
    ) -> None:
        self.core = core
        self._sensors, self._link = SensorPort(steps), ModemPort(modem, period_s)
        self._executive = Executive(
            (
                # Deadlines: hear, sense and fit leave the last fifth of a period to a frame.
                Task(name="hear", period_s=period_s, deadline_s=0.1 * period_s, work=self._hear),
                Task(name="sense", period_s=period_s, deadline_s=0.2 * period_s, work=self._sense),
                Task(name="fit", period_s=period_s, deadline_s=0.5 * period_s, work=core.tick),
                Task(name="speak", period_s=period_s, deadline_s=0.2 * period_s, work=self._speak),
            ),
            stopwatch,
        )

    def step(self, now_s: float) -> None:
        """Do what is due now; never raises."""
        self._executive.step(now_s)

    def status(self) -> dict[str, int]:
        """Return every counter of core, sensors, link and executive."""
        return {
            **self.core.status(),
            **self._sensors.counters,
            **self._link.status(),
            **self._executive.counters,
        }

    def _hear(self, now_s: float) -> None:
        self._link.hear(self._receive, now_s)

    def _receive(self, heard: Reception) -> None:
        self.core.receive_frame(heard.frame, heard.toa_s, heard.heard_s)

    def _sense(self, now_s: float) -> None:
        self._sensors.feed(self.core, now_s)

    def _speak(self, now_s: float) -> None:
        self._link.speak(self.core.poll, now_s)
