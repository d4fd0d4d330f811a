"""Real time for the channel: every tick lasts as long on the wall as in the mission."""

import time

from host_tools.mission import Progress


class Pace:
    """Says when a tick is over, and waits for it."""

    def __init__(self, tick_s: float) -> None:
        self._tick_s, self._began_s = tick_s, 0.0

    def start(self) -> None:
        """Let mission time 0 be now."""
        self._began_s = time.monotonic()

    def is_over(self, now_s: float) -> bool:
        """Return whether the tick's own time is up: a vehicle that has not answered is late."""
        return time.monotonic() - self._began_s >= now_s + self._tick_s

    def after(self, progress: Progress) -> Progress:
        """Return progress, followed by a wait for the end of the tick."""

        def wait(now_s: float) -> None:
            progress(now_s)
            time.sleep(max(0.0, self._began_s + now_s + self._tick_s - time.monotonic()))

        return wait
