"""The leader's loop: one thread between sensors, core and modem, and a bounded worker."""

from collections.abc import Callable, Iterator

from firmware.leader.core import LeaderCore
from firmware.leader.journaled import JournaledLeader
from firmware.leader.worker import Worker
from firmware.ports import SensorStep
from firmware.vehicle_loop import VehicleLoop, Work
from protocol.modems.base import Modem


class LeaderLoop(VehicleLoop):
    """A vehicle's loop whose matches go to the worker."""

    def __init__(
        self,
        core: LeaderCore | JournaledLeader,
        modem: Modem,
        steps: Iterator[SensorStep],
        worker: Worker,
        stopwatch: Callable[[], float],
        period_s: float = 0.25,
    ) -> None:
        super().__init__(core, modem, steps, stopwatch, period_s)
        self._leader, self._worker = core, worker

    def _tasks(self) -> tuple[Work, ...]:
        return (
            ("hear", 0.2, self._hear),
            ("sense", 0.2, self._sense),
            ("collect", 0.2, self.core.tick),
            ("match", 1.0, self._match),
            ("speak", 0.2, self._speak),
        )

    def _match(self, now_s: float) -> None:
        while True:
            finished = self._worker.take()
            if finished is not None:
                self._leader.finish(finished.batch, finished.findings, now_s)
            batch = self._leader.next_jobs() if self._worker.is_free else None
            if batch is None:
                return
            self._worker.give(batch)
