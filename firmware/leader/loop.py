"""The leader's loop: one thread between sensors, core and modem, and a bounded worker."""

from collections.abc import Callable, Iterator

from firmware.executive import Executive, Task
from firmware.leader.core import LeaderCore
from firmware.leader.worker import Worker
from firmware.ports import ModemPort, SensorPort, SensorStep
from protocol.modems.base import Modem, Reception


class LeaderLoop:
    """Reads ports, runs the core, writes ports; matches go to the worker.

    stopwatch returns the seconds by which deadlines are judged; in virtual time it stands still.
    """

    def __init__(
        self,
        core: LeaderCore,
        modem: Modem,
        steps: Iterator[SensorStep],
        worker: Worker,
        stopwatch: Callable[[], float],
        period_s: float = 0.25,
    ) -> None:
        self.core = core
        self._worker = worker
        self._sensors, self._link = SensorPort(steps), ModemPort(modem, period_s)
        self._executive = Executive(
            (
                Task(name="hear", period_s=period_s, deadline_s=0.2 * period_s, work=self._hear),
                Task(name="sense", period_s=period_s, deadline_s=0.2 * period_s, work=self._sense),
                Task(name="collect", period_s=period_s, deadline_s=0.2 * period_s, work=core.tick),
                Task(name="match", period_s=period_s, deadline_s=period_s, work=self._match),
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

    def _match(self, now_s: float) -> None:
        while True:
            finished = self._worker.take()
            if finished is not None:
                self.core.finish(finished.batch, finished.findings, now_s)
            batch = self.core.next_jobs() if self._worker.is_free else None
            if batch is None:
                return
            self._worker.give(batch)

    def _speak(self, now_s: float) -> None:
        self._link.speak(self.core.poll, now_s)
