"""A vehicle's store: every input of its core, in order, in one SQLite file that survives a kill.

The core is a function of its inputs, so the inputs are the state. They are gathered in memory and
committed as one row, about once a second and before anything leaves the vehicle; a row holds a
checksum, and SQLite's write-ahead log drops a torn one whole. A checkpoint, where the core can be
written down, replaces the rows before it.

What is wrong with a store never stops a mission: a file that cannot be used is set aside under
another name, and one that cannot be written is counted while the mission goes on in memory.
"""

import contextlib
import logging
import os
import sqlite3
import zlib
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from protocol.errors import ConfigError, FathomError
from protocol.settings import Settings, setting

LOG = logging.getLogger(__name__)
SCHEMA = "2"
BOOT_EPOCHS = 16  # the header has 4 bits for it
LIFE_S = 40.0
"""A life that is shorter has sent no sub-map: lives that no disk counts are told apart by this."""
REPLAYS_TRIED = 5
"""A store whose replay ended the process so often is set aside: something in it is deadly."""

_TABLES = """
CREATE TABLE about (name TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE inputs (number INTEGER PRIMARY KEY, checksum INTEGER NOT NULL, body BLOB NOT NULL);
CREATE TABLE checkpoint (one INTEGER PRIMARY KEY CHECK (one = 1), after INTEGER NOT NULL,
                         checksum INTEGER NOT NULL, body BLOB NOT NULL);
CREATE TABLE shelf (name TEXT PRIMARY KEY, body BLOB NOT NULL)
"""
_LENGTH_BYTES = 4


class StoreUnusableError(FathomError):
    """Why a store cannot be resumed from; it is set aside."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JournalSettings(Settings):
    """How much a power failure may cost, and how much a store may hold."""

    commit_s: float = setting(
        1.0, "s", "navigation lost at worst; a commit is one sync of the disk", minimum=0.0
    )
    checkpoint_s: float = setting(
        60.0, "s", "what a follower measures again after a restart", minimum=1.0
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
        return "leader" if self.vehicle == 0 else f"follower_{self.vehicle}"


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
        self._owner, self._path = owner, folder / f"{owner.name}.sqlite"
        self._waiting: list[bytes] = []
        self._full: deque[tuple[int, bytes]] = deque()  # rows that the disk did not take
        self._number, self._is_resumed = 0, False
        self._epoch_file = folder / f"{owner.name}.epoch"
        self._connection: sqlite3.Connection | None = None
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
        if self._connection is not None:
            self._waiting.append(bytes([kind]) + len(body).to_bytes(_LENGTH_BYTES) + body)

    def commit(self) -> None:
        """Put everything appended on disk; what a full disk refuses waits, up to a cap."""
        if self._connection is None or not (self._waiting or self._full):
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
        """Commit, and let the core as written down here replace all rows so far."""
        self.commit()
        if self._connection is None or self._full:
            return
        packed = zlib.compress(body, 1)
        row = (self._number, zlib.crc32(packed, self._number), packed)
        try:
            with self._transaction(self._connection):
                self._connection.execute("REPLACE INTO checkpoint VALUES (1, ?, ?, ?)", row)
                self._connection.execute("DELETE FROM inputs WHERE number <= ?", row[:1])
            self.counters["store_checkpoints"] += 1
        except sqlite3.Error:
            self.counters["store_commits_failed"] += 1

    def checkpointed(self) -> bytes | None:
        """Return the newest checkpoint, or None."""
        row = self._one("SELECT body FROM checkpoint")
        return None if row is None else zlib.decompress(row[0])

    def put(self, name: str, body: bytes) -> None:
        """Put away what is wanted seldom; a disk that does not take it loses it, counted."""
        try:
            if self._connection is None:
                raise sqlite3.OperationalError("no store")
            self._connection.execute("REPLACE INTO shelf VALUES (?, ?)", (name, body))
        except sqlite3.Error:
            self.counters["store_shelf_lost"] += 1

    def get(self, name: str) -> bytes | None:
        """Return what was put away under a name, or None."""
        row = self._one("SELECT body FROM shelf WHERE name = ?", name)
        return None if row is None else bytes(row[0])

    def replay(self) -> Iterator[tuple[int, bytes]]:
        """Yield kind and body of every input since the checkpoint, in order.

        The store knows when this is not run to its end; after REPLAYS_TRIED such times it is
        set aside.
        """
        if self._connection is None:
            return
        tried = int(self._about("replays", "0"))
        self._tell("replays", str(tried + 1))
        for (packed,) in self._connection.execute("SELECT body FROM inputs ORDER BY number"):
            yield from _split(zlib.decompress(packed))
        self._tell("replays", "0")

    def start(self, text: str) -> str:
        """Return what the vehicle was started from: the text, unless the store knows better."""
        kept = self._about("start", "")
        if not kept:
            self._tell("start", text)
        return kept or text

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
        self._close()

    # inside

    def _open(self) -> None:
        if not self._path.exists():
            self._begin(self._next_epoch())
            return
        try:
            self._resume()
        except (sqlite3.DatabaseError, StoreUnusableError, ValueError, zlib.error) as error:
            self._close()
            if _is_about_access(error):
                raise
            self._begin_after(str(error))

    def _resume(self) -> None:
        """Take an existing file, after reading all of it against its checksums."""
        self._connect()
        if self._about("schema", "") != SCHEMA:
            raise StoreUnusableError("it is from another version of this program")
        vehicle = int(self._about("vehicle", "-1"))
        if vehicle != self._owner.vehicle:
            raise ConfigError(
                f"{self._path} is the store of vehicle {vehicle}, not of "
                f"{self._owner.vehicle}; give each vehicle a folder of its own"
            )
        if self._about("fingerprint", "") != self._owner.fingerprint:
            raise StoreUnusableError("it is of another mission, configuration or version")
        if int(self._about("replays", "0")) >= REPLAYS_TRIED:
            raise StoreUnusableError(f"its replay ended the process {REPLAYS_TRIED} times")
        self.boot_epoch = int(self._about("epoch", "0"))
        self._number = self._verified()
        self._is_resumed = bool(self._about("start", ""))

    def _verified(self) -> int:
        """Return the number of the last row; raise StoreUnusableError if one is wrong or gone."""
        assert self._connection is not None
        last = 0
        row = self._one("SELECT after, checksum, body FROM checkpoint")
        if row is not None:
            last = row[0]
            if zlib.crc32(row[2], last) != row[1]:
                raise StoreUnusableError("its checkpoint is damaged")
        rows = self._connection.execute("SELECT number, checksum, body FROM inputs ORDER BY number")
        for number, checksum, body in rows:
            if number != last + 1 or zlib.crc32(body, number) != checksum:
                raise StoreUnusableError(f"row {last + 1} is damaged or gone")
            last = number
        return last

    def _begin_after(self, why: str) -> None:
        aside = _set_aside(self._path)
        self.counters["store_set_aside"] += 1
        LOG.warning("store %s is not used: %s; it is kept as %s", self._path, why, aside.name)
        self._begin(self._next_epoch())

    def _begin(self, epoch: int) -> None:
        """Make a new store; its epoch is on disk before anything can be sent in it."""
        self.boot_epoch, self._number = epoch, 0
        _write_whole(self._epoch_file, f"{epoch}\n")
        self._connect()
        assert self._connection is not None
        about = {
            "schema": SCHEMA,
            "vehicle": str(self._owner.vehicle),
            "fingerprint": self._owner.fingerprint,
            "epoch": str(epoch),
        }
        with self._transaction(self._connection):
            for statement in _TABLES.split(";"):
                self._connection.execute(statement)
            self._connection.executemany("INSERT INTO about VALUES (?, ?)", about.items())

    def _next_epoch(self) -> int:
        try:
            return (int(self._epoch_file.read_text(encoding="ascii")) + 1) % BOOT_EPOCHS
        except FileNotFoundError:
            return 0
        except (OSError, ValueError):
            self.counters["store_epoch_unreadable"] += 1
            return len(list(self._path.parent.glob(f"{self._owner.name}.aside-*"))) % BOOT_EPOCHS

    def _connect(self) -> None:
        self._connection = sqlite3.connect(
            self._path, timeout=2.0, isolation_level=None, check_same_thread=False
        )
        try:
            for pragma in (
                "locking_mode = EXCLUSIVE",
                "journal_mode = WAL",
                "synchronous = FULL",  # a commit survives a power failure
                "journal_size_limit = 4000000",
            ):
                self._connection.execute(f"PRAGMA {pragma}").fetchall()
            self._connection.execute("BEGIN IMMEDIATE")
            self._connection.execute("COMMIT")
        except sqlite3.OperationalError as error:
            if "locked" not in str(error):
                raise
            self._close()
            raise ConfigError(f"{self._path} is in use by another process; end it first") from error

    def _write_rows(self) -> None:
        assert self._connection is not None
        with self._transaction(self._connection):
            self._connection.executemany(
                "INSERT INTO inputs VALUES (?, ?, ?)",
                [(number, zlib.crc32(body, number), body) for number, body in self._full],
            )
        self.counters["store_commits"] += 1
        self.counters["store_bytes"] += sum(len(body) for _, body in self._full)
        self._full.clear()

    @contextlib.contextmanager
    def _transaction(self, connection: sqlite3.Connection) -> Iterator[None]:
        connection.execute("BEGIN IMMEDIATE")
        try:
            yield
            connection.execute("COMMIT")
        except BaseException:
            if connection.in_transaction:
                connection.execute("ROLLBACK")
            raise

    def _one(self, query: str, *values: str) -> tuple[Any, ...] | None:
        if self._connection is None:
            return None
        row: tuple[Any, ...] | None = self._connection.execute(query, values).fetchone()
        return row

    def _about(self, name: str, otherwise: str) -> str:
        row = self._one("SELECT value FROM about WHERE name = ?", name)
        return otherwise if row is None else str(row[0])

    def _tell(self, name: str, value: str) -> None:
        if self._connection is not None:
            with contextlib.suppress(sqlite3.Error):
                self._connection.execute("REPLACE INTO about VALUES (?, ?)", (name, value))

    def _lose_from_the_start(self, error: Exception) -> None:
        """Go on in memory, in an epoch by the clock: the disk does not count this life."""
        self.boot_epoch = uncounted_epoch(self._next_epoch(), self._began_s)
        self._lose(error)

    def _lose(self, error: Exception) -> None:
        """Go on in memory; what is on disk stays as it is."""
        self.counters["store_lost"] += 1
        LOG.warning("store %s: %s; the mission goes on in memory", self._path, error)
        self._close()

    def _close(self) -> None:
        if self._connection is not None:
            with contextlib.suppress(sqlite3.Error):
                self._connection.close()
        self._connection = None
        self._waiting, self._full = [], deque()


def uncounted_epoch(following: int, began_s: float) -> int:
    """Return the epoch of a life that is not counted on a disk, whose next count is `following`.

    It is neither that nor the one before, and another than that of any life that began at least
    LIFE_S and at most eight minutes earlier.
    """
    return (following + 1 + int(began_s // LIFE_S) % (BOOT_EPOCHS - 2)) % BOOT_EPOCHS


def _split(data: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at < len(data):
        first = at + 1 + _LENGTH_BYTES
        end = first + int.from_bytes(data[at + 1 : first])
        yield data[at], data[first:end]
        at = end


def _is_about_access(error: Exception) -> bool:
    """Return whether the disk or its rights are to blame, not what the file holds."""
    return isinstance(error, sqlite3.OperationalError) and any(
        word in str(error) for word in ("unable to open", "readonly", "full", "disk I/O")
    )


def _set_aside(path: Path) -> Path:
    """Give a store, its log beside it, the first free name; return it."""
    number = 1
    while (aside := path.with_name(f"{path.stem}.aside-{number}{path.suffix}")).exists():
        number += 1
    path.rename(aside)
    for suffix in ("-wal", "-shm"):
        beside = path.with_name(path.name + suffix)
        if beside.exists():
            beside.rename(aside.with_name(aside.name + suffix))
    return aside


def _write_whole(path: Path, text: str) -> None:
    """Write a small file so that after any crash it holds the old text or the new."""
    fresh = path.with_name(path.name + ".new")
    with fresh.open("w", encoding="ascii") as stream:
        stream.write(text)
        stream.flush()
        os.fsync(stream.fileno())
    fresh.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
