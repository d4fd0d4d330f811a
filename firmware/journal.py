"""A vehicle's store: every input of its core, in order, in one SQLite file that survives a kill.

The core is a function of its inputs, so the inputs are the state. They are gathered in memory and
committed as one row, about once a second and before anything leaves the vehicle; a row holds a
checksum, and SQLite's write-ahead log drops a torn one whole. A checkpoint, where the core can be
written down, replaces the rows before it; a thread compresses it, so that no ping waits.

What is wrong with a store never stops a mission: a file that cannot be used is set aside under
another name, and one that cannot be written is counted while the mission goes on in memory.
"""

import contextlib
import logging
import sqlite3
import zlib
from collections import Counter, deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from firmware.boot_epochs import EpochFile, uncounted_epoch
from firmware.store_file import StoreFile, StoreUnusableError, is_about_access
from protocol.errors import ConfigError
from protocol.settings import Settings, setting
from protocol.vehicles import BOOT_EPOCHS, name_of

LOG = logging.getLogger(__name__)
REPLAYS_TRIED = 5
"""A store whose replay ended the process so often is set aside: something in it is deadly."""

_LENGTH_BYTES = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class JournalSettings(Settings):
    """How much a power failure may cost, and how much a store may hold."""

    commit_s: float = setting(
        1.0, "s", "navigation lost at worst; a commit is one sync of the disk", minimum=0.0
    )
    checkpoint_s: float = setting(
        60.0,
        "s",
        "between checkpoints of a follower: a restart replays what came since",
        minimum=1.0,
    )
    waiting_bytes: int = setting(
        4_000_000, "bytes", "kept for a disk that is full: twenty minutes of pings", minimum=1000
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Owner:
    """Whose store it is; the fingerprint is that of configuration and program."""

    vehicle: int
    fingerprint: str

    @property
    def name(self) -> str:
        """The vehicle's name in files."""
        return name_of(self.vehicle)


class Journal:
    """Inputs in by `append`, on disk by `commit`, out again by `replay`; never raises at sea.

    Raises
    ------
    ConfigError
        On opening: when another process holds the store, or it is another vehicle's.
    """

    def __init__(
        self, folder: Path, owner: Owner, settings: JournalSettings, began_s: float = 0.0
    ) -> None:
        self.settings, self.counters = settings, Counter[str]()
        self._began_s = began_s  # of this life, by the mission's clock
        self._owner, self._file = owner, self._file_at(folder / f"{owner.name}.sqlite")
        self._waiting: list[bytes] = []
        self._full: deque[tuple[int, bytes]] = deque()  # rows that the disk did not take
        self._number, self._is_resumed = 0, False
        self._compressor = ThreadPoolExecutor(1, thread_name_prefix="checkpoint")
        self._checkpoint: tuple[int, Future[bytes]] | None = None  # the last row before, and body
        self._epochs = EpochFile(folder / f"{owner.name}.epoch")
        self.boot_epoch = 0
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._open()
        except (OSError, sqlite3.Error) as error:
            self._lose_from_the_start(error)

    @property
    def is_resumed(self) -> bool:
        """Whether there is something to replay."""
        return self._is_resumed

    def append(self, kind: int, body: bytes = b"") -> None:
        """Add one input to those that the next commit writes."""
        if self._file.is_open:
            self._waiting.append(bytes([kind]) + len(body).to_bytes(_LENGTH_BYTES) + body)

    def commit(self) -> None:
        """Put everything appended on disk; what a full disk refuses waits, up to a cap."""
        if self._checkpoint is not None and self._checkpoint[1].done():
            self._write_checkpoint()
        if not self._file.is_open or not (self._waiting or self._full):
            return
        if self._waiting:
            body = zlib.compress(b"".join(self._waiting), 1)
            self._number += 1
            self._full.append((self._number, body))
            self._waiting = []
        try:
            self._write_rows()
        except sqlite3.Error as error:
            self.counters["store_commits_failed"] += 1
            if sum(len(row) for _, row in self._full) > self.settings.waiting_bytes:
                self._lose(error)

    def checkpoint(self, body: bytes) -> None:
        """Commit, and let the core as written down here replace all rows so far, at a commit soon.

        An earlier one that is not yet written is waited for.
        """
        self._write_checkpoint()
        self.commit()
        if not self._file.is_open or self._full:
            return
        try:
            self._checkpoint = self._number, self._compressed(body)
        except RuntimeError:  # there is no thread to be had
            self.counters["store_checkpoints_put_off"] += 1

    def checkpointed(self) -> bytes | None:
        """Return the newest checkpoint, or None.

        Raises StoreUnusableError if it can be read no longer.
        """
        with _reading():
            packed = self._file.checkpoint()
            return None if packed is None else zlib.decompress(packed)

    def put(self, name: str, body: bytes) -> bool:
        """Put away what is wanted seldom; return whether the disk took it: if not, counted."""
        try:
            self._file.put(name, body)
        except sqlite3.Error:
            self.counters["store_shelf_refused"] += 1
            return False
        return True

    def drop(self, name: str) -> None:
        """Throw away what was put away; where the disk does not allow it, it stays, counted."""
        try:
            self._file.drop(name)
        except sqlite3.Error:
            self.counters["store_shelf_stuck"] += 1

    def get(self, name: str) -> bytes | None:
        """Return what was put away under a name, or None, counted, if it can be had no more."""
        try:
            body = self._file.get(name)
        except sqlite3.Error:
            body = None
        if body is None:
            self.counters["store_shelf_unread"] += 1
        return body

    def replay(self) -> Iterator[tuple[int, bytes]]:
        """Yield kind and body of every input since the checkpoint, in order.

        The store knows when this is not run to its end; after REPLAYS_TRIED such times it is
        set aside. Raises StoreUnusableError for what can be read no longer.
        """
        if not self._file.is_open:
            return
        with _reading():
            tried = int(self._file.about("replays", "0"))
            self._file.tell("replays", str(tried + 1))
            for packed in self._file.inputs():
                yield from _split(zlib.decompress(packed))
            self._file.tell("replays", "0")

    def start(self, text: str) -> str:
        """Return what the vehicle was started from: the text, unless the store knows better."""
        kept = self._file.about("start", "")
        if not kept:
            self._file.tell("start", text)
        return kept or text

    def count_epoch(self, epoch: int) -> None:
        """Count an epoch that a core has begun by itself: its next life takes another."""
        if epoch == self.boot_epoch:
            return
        self.boot_epoch = epoch
        try:
            self._epochs.write(epoch)
        except OSError:
            self.counters["store_epochs_uncounted"] += 1

    def give_up(self, why: str) -> None:
        """Set this store aside and begin a new one in the next boot epoch."""
        self._close()
        self._is_resumed = False
        try:
            self._begin_after(why)
        except (OSError, sqlite3.Error) as error:
            self._lose_from_the_start(error)

    def close(self) -> None:
        """Commit and close."""
        self.commit()
        self._write_checkpoint()
        self._close()
        self._compressor.shutdown(wait=False)

    def _file_at(self, path: Path) -> StoreFile:
        """Return the file of this store; simulated disks take another."""
        return StoreFile(path)

    def _open(self) -> None:
        if not self._file.path.exists():
            self._begin(self._next_epoch())
            return
        try:
            self._resume()
        except (sqlite3.DatabaseError, StoreUnusableError, ValueError, zlib.error) as error:
            self._close()
            if is_about_access(error):
                raise
            self._begin_after(str(error))

    def _resume(self) -> None:
        """Take an existing file, after reading all of it against its checksums."""
        self._file.open()
        vehicle = int(self._file.about("vehicle"))
        if vehicle != self._owner.vehicle:
            raise ConfigError(
                f"{self._file.path} is the store of vehicle {vehicle}, not of "
                f"{self._owner.vehicle}; give each vehicle a folder of its own"
            )
        if self._file.about("fingerprint") != self._owner.fingerprint:
            raise StoreUnusableError("it is of another mission, configuration or version")
        if int(self._file.about("replays", "0")) >= REPLAYS_TRIED:
            raise StoreUnusableError(f"its replay ended the process {REPLAYS_TRIED} times")
        self.boot_epoch = int(self._file.about("epoch"))
        self._number = self._file.verified()
        self._is_resumed = bool(self._file.about("start", None if self._number else ""))

    def _begin_after(self, why: str) -> None:
        aside = self._file.set_aside()
        self.counters["store_set_aside"] += 1
        LOG.warning("store %s is not used: %s; it is kept as %s", self._file.path, why, aside.name)
        self._begin(self._next_epoch())

    def _begin(self, epoch: int) -> None:
        """Make a new store; its epoch is on disk before anything can be sent in it."""
        self.boot_epoch, self._number = epoch, 0
        self._epochs.write(epoch)
        self._file.create(
            {
                "vehicle": str(self._owner.vehicle),
                "fingerprint": self._owner.fingerprint,
                "epoch": str(epoch),
            }
        )

    def _next_epoch(self) -> int:
        try:
            return self._epochs.following()
        except (OSError, ValueError):
            self.counters["store_epoch_unreadable"] += 1
            return len(self._file.all_aside()) % BOOT_EPOCHS

    def _compressed(self, body: bytes) -> Future[bytes]:
        return self._compressor.submit(zlib.compress, body, 1)

    def _write_rows(self) -> None:
        self._file.write(self._full)
        self.counters["store_commits"] += 1
        self.counters["store_bytes"] += sum(len(body) for _, body in self._full)
        self._full.clear()

    def _write_checkpoint(self) -> None:
        """Write the checkpoint that is on its way, if one is."""
        if self._checkpoint is None:
            return
        (number, compressed), self._checkpoint = self._checkpoint, None
        try:
            self._file.write_checkpoint(number, compressed.result())
            self.counters["store_checkpoints"] += 1
        except sqlite3.Error:
            self.counters["store_commits_failed"] += 1
        except MemoryError:  # the rows are still there
            self.counters["store_checkpoints_put_off"] += 1

    def _lose_from_the_start(self, error: Exception) -> None:
        """Go on in memory, in an epoch by the clock: the disk does not count this life."""
        self.boot_epoch = uncounted_epoch(self._next_epoch(), self._began_s)
        self._lose(error)

    def _lose(self, error: Exception) -> None:
        """Go on in memory; what is on disk stays as it is."""
        self.counters["store_lost"] += 1
        LOG.warning("store %s: %s; the mission goes on in memory", self._file.path, error)
        self._close()
        self._compressor.shutdown(wait=False)

    def _close(self) -> None:
        self._file.close()
        self._waiting, self._full, self._checkpoint = [], deque(), None


@contextlib.contextmanager
def _reading() -> Iterator[None]:
    """Let a store that can be read no longer be one that cannot be used."""
    try:
        yield
    except (sqlite3.Error, zlib.error) as error:
        raise StoreUnusableError(str(error)) from error


def _split(data: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at < len(data):
        first = at + 1 + _LENGTH_BYTES
        end = first + int.from_bytes(data[at + 1 : first])
        yield data[at], data[first:end]
        at = end
