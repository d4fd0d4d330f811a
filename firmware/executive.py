"""A cyclic executive: named tasks with periods and deadlines, in one thread, in a fixed order."""

import logging
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

LOG = logging.getLogger(__name__)
_EARLY_S = 1e-6
_TOLD_EVERY_S = 60.0  # of a task that fails again and again: its traceback must not fill a disk


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """Work to be done every period; a longer run than the deadline is counted."""

    name: str
    period_s: float
    deadline_s: float
    work: Callable[[float], None]


class Executive:
    """Runs the tasks that are due, in order; what goes wrong in one does not stop the others."""

    def __init__(self, tasks: Sequence[Task], stopwatch: Callable[[], float]) -> None:
        self._tasks, self._stopwatch = tuple(tasks), stopwatch
        self._due_s = {task.name: -float("inf") for task in self._tasks}
        self._told_s = dict(self._due_s)
        self.counters: Counter[str] = Counter()

    def step(self, now_s: float) -> None:
        """Run what is due; nothing raised by a task passes here."""
        for task in self._tasks:
            wait_s = self._due_s[task.name] - now_s
            if _EARLY_S < wait_s <= task.period_s:  # longer: the clock was set back
                continue
            self._due_s[task.name] = now_s + task.period_s
            began_s = self._stopwatch()
            try:
                task.work(now_s)
            except Exception:
                self.counters[f"{task.name}_failed"] += 1
                if abs(now_s - self._told_s[task.name]) >= _TOLD_EVERY_S:
                    self._told_s[task.name] = now_s
                    LOG.exception("%s failed at %.3f s", task.name, now_s)
            if self._stopwatch() - began_s > task.deadline_s:
                self.counters[f"{task.name}_overran"] += 1
