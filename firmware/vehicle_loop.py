"""A vehicle's loop: one thread, a cyclic executive between sensors, core and modem."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator

from firmware.executive import Executive, Task
from firmware.ports import ModemPort, SensorPort, SensorStep
from firmware.vehicle_core import VehicleCore
from protocol.modems.base import Modem, Reception

Work = tuple[str, float, Callable[[float], None]]
"""A task's name, its deadline as a share of the period, and what it does at a time."""


class VehicleLoop(ABC):
    """Reads ports, runs the core, writes ports; `step` is called once a period of the clock.

    stopwatch returns the seconds by which deadlines are judged; in virtual time it stands still.
    """

    def __init__(
        self,
        core: VehicleCore,
        modem: Modem,
        steps: Iterator[SensorStep],
        stopwatch: Callable[[], float],
        period_s: float = 0.25,
    ) -> None:
        self.core = core
        self._sensors, self._link = SensorPort(steps), ModemPort(modem, period_s)
        tasks = [
            Task(name=name, period_s=period_s, deadline_s=share * period_s, work=work)
            for name, share, work in self._tasks()
        ]
        self._executive = Executive(tasks, stopwatch)
        self._stopwatch, self._began_s = stopwatch, 0.0

    def step(self, now_s: float) -> None:
        """Do what is due now; never raises."""
        self._began_s = self._stopwatch()
        self._executive.step(now_s)

    def status(self) -> dict[str, int]:
        """Return every counter of core, sensors, link and executive."""
        return {
            **self.core.status(),
            **self._sensors.counters,
            **self._link.status(),
            **self._executive.counters,
        }

    @abstractmethod
    def _tasks(self) -> tuple[Work, ...]:
        """Return what a role does in a period, in order."""

    def _hear(self, now_s: float) -> None:
        self._link.hear(self._receive, now_s)

    def _receive(self, heard: Reception) -> None:
        self.core.receive_frame(heard.frame, heard.toa_s, heard.heard_s)

    def _sense(self, now_s: float) -> None:
        self._sensors.feed(self.core, now_s)

    def _speak(self, now_s: float) -> None:
        self._link.speak(self.core.poll, now_s, self._stopwatch() - self._began_s)
