"""A disk that is full, read-only, torn or damaged: for counters and marks, and for a journal."""

import errno
import sqlite3
import zlib
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from firmware.journal import Journal, JournalSettings, Owner
from firmware.store_file import StoreFile
from host_tools.faults.catalogue import DEADLY, Fault, Plan
from host_tools.kills import KilledError


class Fate:
    """The disk of one vehicle, and the death of its computer at an event that is drawn.

    `is_read_only` holds for all lives after the one in which it became so, until the fault ends.
    """

    def __init__(self, vehicle: int, plan: Plan, rng: np.random.Generator) -> None:
        self.now_s = 0.0
        self.struck: Fault | None = None
        self._vehicle, self._plan, self._rng = vehicle, plan, rng
        self._deaths = sorted(
            (s for s in plan.strikes if s.fault in DEADLY and s.vehicle == vehicle),
            key=lambda s: s.from_s,
        )
        self._countdown: int | None = None
        self._is_full = Fault.DISK_FULL in plan.kinds(vehicle)
        self._may_read_only = Fault.STORE_READ_ONLY in plan.kinds(vehicle)

    def strike(self) -> None:
        """Let an event pass; raise KilledError when it is the last one of this life."""
        if self._deaths and self._countdown is None and self.now_s >= self._deaths[0].from_s:
            self._countdown = int(self._rng.integers(1, 20))
        if self._countdown is None or self._deaths[0].fault is Fault.TORN_WRITE:
            return
        self._countdown -= 1
        if self._countdown <= 0:
            self._die()

    def tear(self, size: int) -> int | None:
        """Return how much of a write of that size is on disk when the computer dies in it."""
        self.strike()
        due = self._deaths and self._countdown is not None
        if not due or self._deaths[0].fault is not Fault.TORN_WRITE:
            return None
        return int(self._rng.integers(0, size + 1))

    def die_torn(self) -> None:
        """Die within a write."""
        self._die()

    def refuses_writes(self) -> bool:
        """Return whether the disk takes nothing now, and count it."""
        for fault, ever in (
            (Fault.DISK_FULL, self._is_full),
            (Fault.STORE_READ_ONLY, self._may_read_only and self.struck is Fault.STORE_READ_ONLY),
        ):
            if ever and self._plan.active(fault, self._vehicle, self.now_s) is not None:
                self._plan.fired[fault] += 1
                return True
        return False

    def fired(self, fault: Fault) -> None:
        """Count damage done."""
        self._plan.fired[fault] += 1

    def down_s(self) -> float:
        """Return how long the computer stays down this time: up to half a minute."""
        return float(np.ceil(self._rng.uniform(0.0, 30.0)))

    def damage(self, data: bytes) -> bytes:
        """Return bytes with some of them changed."""
        damaged = bytearray(data)
        for at in self._rng.integers(0, max(len(data), 1), size=20 if data else 0):
            damaged[at] ^= int(self._rng.integers(1, 256))
        return bytes(damaged)

    def _die(self) -> None:
        strike = self._deaths.pop(0)
        self._countdown, self.struck = None, strike.fault
        if strike.fault in {Fault.KILLED, Fault.TORN_WRITE}:
            self.fired(strike.fault)
        raise KilledError


class MemoryFiles:
    """Small files in memory, under a fate."""

    def __init__(self, fate: Fate) -> None:
        self.texts: dict[Path, str] = {}
        self._fate = fate

    def read(self, path: Path) -> str:
        """Return a file's text."""
        self._fate.strike()
        if path not in self.texts:
            raise FileNotFoundError(path)
        return self.texts[path]

    def write(self, path: Path, text: str) -> None:
        """Write; the rename at the end makes a torn write the old text or the new."""
        if self._fate.refuses_writes():
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        torn = self._fate.tear(len(text))
        if torn is None or torn == len(text):
            self.texts[path] = text
        if torn is not None:
            self._fate.die_torn()

    def after_death(self) -> None:
        """Do to the files what the fault that struck does."""
        paths = sorted(self.texts)
        if self._fate.struck is Fault.COUNTER_LOST:
            for path in paths:
                if "counter" in path.name:
                    del self.texts[path]
                    self._fate.fired(Fault.COUNTER_LOST)
        if self._fate.struck is Fault.STORE_CORRUPT and paths:
            path = paths[int(self._fate.down_s()) % len(paths)]
            text = self.texts[path].encode()
            self.texts[path] = self._fate.damage(text).decode("latin-1")
            self._fate.fired(Fault.STORE_CORRUPT)


class FatedJournal(Journal):
    """A journal on the real disk, under a fate."""

    def __init__(
        self, folder: Path, owner: Owner, settings: JournalSettings, fate: Fate, began_s: float
    ) -> None:
        self._fate, self._at = fate, folder / f"{owner.name}.sqlite"
        super().__init__(folder, owner, settings, began_s)

    def append(self, kind: int, body: bytes = b"") -> None:
        """Append, unless death comes first."""
        self._fate.strike()
        super().append(kind, body)

    def commit(self) -> None:
        """Commit; death may come before it, within it, or just after."""
        self._fate.strike()
        log = self._at.with_name(self._at.name + "-wal")
        before = log.stat().st_size if log.exists() else 0
        super().commit()
        after = log.stat().st_size if log.exists() else 0
        torn = self._fate.tear(max(after - before, 0))
        if torn is not None:
            files = self._snapshot()
            if log in files:
                files[log] = files[log][: before + torn]
            self.abandon(files)
            self._fate.die_torn()
        self._fate.strike()

    def _compressed(self, body: bytes) -> Future[bytes]:
        """Return at once what a thread would bring at some time: a fate's bytes are its seed's."""
        done: Future[bytes] = Future()
        done.set_result(zlib.compress(body, 1))
        return done

    def abandon(self, files: dict[Path, bytes] | None = None) -> None:
        """Leave the files as a dead process does, what waits is lost, the lock is free."""
        is_torn = files is not None  # and the death is still to come
        files = self._snapshot() if files is None else files
        self._close()
        if self._fate.struck is Fault.STORE_CORRUPT and not is_torn:
            files = {path: self._fate.damage(data) for path, data in files.items()}
            self._fate.fired(Fault.STORE_CORRUPT)
        for path, data in files.items():
            path.write_bytes(data)

    def _snapshot(self) -> dict[Path, bytes]:
        folder, name = self._at.parent, self._at.name
        return {p: p.read_bytes() for p in sorted(folder.glob(f"{name}*")) if "-shm" not in p.name}

    def _file_at(self, path: Path) -> StoreFile:
        return FatedFile(path, self._fate)


class FatedFile(StoreFile):
    """The file of such a journal: on a disk that may refuse to be written."""

    def __init__(self, path: Path, fate: Fate) -> None:
        super().__init__(path)
        self._fate = fate

    def _connect(self) -> None:
        if self._fate.refuses_writes():
            raise sqlite3.OperationalError("unable to open database file")
        super()._connect()

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        if self._fate.refuses_writes():
            raise sqlite3.OperationalError("database or disk is full")
        with super()._transaction() as database:
            yield database
