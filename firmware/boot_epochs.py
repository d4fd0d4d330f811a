"""Which of its lives a vehicle is in, counted on a disk or, where there is none, by the clock."""

from pathlib import Path

from protocol.seal_state import write_durably
from protocol.vehicles import BOOT_EPOCHS

LIFE_S = 40.0
"""A life that is shorter has sent no sub-map: lives that no disk counts are told apart by this."""


class EpochFile:
    """The epoch of the newest life, beside the store and not in it: it outlasts a damaged store."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def following(self) -> int:
        """Return the epoch of the next life; raise OSError or ValueError if nobody can tell."""
        try:
            return (int(self._path.read_text(encoding="ascii")) + 1) % BOOT_EPOCHS
        except FileNotFoundError:
            return 0

    def write(self, epoch: int) -> None:
        """Count a life."""
        write_durably(self._path, f"{epoch}\n")


def uncounted_epoch(following: int, began_s: float) -> int:
    """Return the epoch of a life that is not counted on a disk, whose next count is `following`.

    It is neither that nor the one before, and another than that of any life that began at least
    LIFE_S and at most eight minutes earlier.
    """
    return (following + 1 + int(began_s // LIFE_S) % (BOOT_EPOCHS - 2)) % BOOT_EPOCHS
