"""The SQLite file that a journal writes: its tables, and what makes it one that cannot be used.

What goes wrong raises here, as sqlite3 has it; what is to be done about it is the journal's.
"""

import contextlib
import sqlite3
import zlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from protocol.errors import ConfigError, FathomError

SCHEMA = "13"
_TABLES = """
CREATE TABLE about (name TEXT PRIMARY KEY, checksum INTEGER NOT NULL, value TEXT NOT NULL);
CREATE TABLE inputs (number INTEGER PRIMARY KEY, checksum INTEGER NOT NULL, body BLOB NOT NULL);
CREATE TABLE checkpoint (one INTEGER PRIMARY KEY CHECK (one = 1), after INTEGER NOT NULL,
                         checksum INTEGER NOT NULL, body BLOB NOT NULL);
CREATE TABLE shelf (name TEXT PRIMARY KEY, checksum INTEGER NOT NULL, body BLOB NOT NULL)
"""


class StoreUnusableError(FathomError):
    """Why a store cannot be resumed from; it is set aside."""


class StoreFile:
    """Rows of inputs, the newest checkpoint, a shelf, and what the store tells about itself."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._connection: sqlite3.Connection | None = None

    @property
    def is_open(self) -> bool:
        """Whether there is something to write to."""
        return self._connection is not None

    def create(self, about: Mapping[str, str]) -> None:
        """Make the file, with what it tells about itself."""
        self._connect()
        told = {"schema": SCHEMA, **about}.items()
        rows = [_about_row(name, value) for name, value in told]
        with self._transaction() as database:
            for statement in _TABLES.split(";"):
                database.execute(statement)
            database.executemany("INSERT INTO about VALUES (?, ?, ?)", rows)

    def open(self) -> None:
        """Open a file that exists; raise StoreUnusableError if it is of another version."""
        self._connect()
        row = self._one("SELECT value FROM about WHERE name = 'schema'")
        if row != (SCHEMA,):
            raise StoreUnusableError("it is from another version of this program")

    def verified(self) -> int:
        """Return the number of the last row; raise StoreUnusableError if one is wrong or gone."""
        for table in ("checkpoint", "inputs"):
            if self._one(f"PRAGMA quick_check({table})") != ("ok",):  # rows alone do not show it
                raise StoreUnusableError(f"its pages of {table} are damaged")
        last = 0
        row = self._one("SELECT after, checksum, body FROM checkpoint")
        if row is not None:
            last = row[0]
            if not _is_whole(*row):
                raise StoreUnusableError("its checkpoint is damaged")
        rows = self._database.execute("SELECT number, checksum, body FROM inputs ORDER BY number")
        for row in rows:
            if row[0] != last + 1 or not _is_whole(*row):
                raise StoreUnusableError(f"row {last + 1} is damaged or gone")
            last = row[0]
        return last

    def write(self, rows: Iterable[tuple[int, bytes]]) -> None:
        """Put numbered rows of inputs on disk, all or none."""
        with self._transaction() as database:
            database.executemany(
                "INSERT INTO inputs VALUES (?, ?, ?)",
                [(number, zlib.crc32(body, number), body) for number, body in rows],
            )

    def inputs(self) -> Iterator[bytes]:
        """Yield the rows since the checkpoint, in order."""
        for (body,) in self._database.execute("SELECT body FROM inputs ORDER BY number"):
            yield body

    def write_checkpoint(self, number: int, body: bytes) -> None:
        """Let a checkpoint replace all rows up to a number."""
        row = (number, zlib.crc32(body, number), body)
        with self._transaction() as database:
            database.execute("REPLACE INTO checkpoint VALUES (1, ?, ?, ?)", row)
            database.execute("DELETE FROM inputs WHERE number <= ?", row[:1])

    def checkpoint(self) -> bytes | None:
        """Return the newest checkpoint, or None."""
        row = self._one("SELECT body FROM checkpoint")
        return None if row is None else bytes(row[0])

    def put(self, name: str, body: bytes) -> None:
        """Put something on the shelf; raise sqlite3.Error if it cannot be."""
        row = (name, zlib.crc32(body, _number(name)), body)
        self._database.execute("REPLACE INTO shelf VALUES (?, ?, ?)", row)

    def drop(self, name: str) -> None:
        """Take something off the shelf; raise sqlite3.Error if it cannot be."""
        self._database.execute("DELETE FROM shelf WHERE name = ?", (name,))

    def get(self, name: str) -> bytes | None:
        """Return what is on the shelf under a name, or None if it is gone or damaged."""
        row = self._one("SELECT checksum, body FROM shelf WHERE name = ?", name)
        return bytes(row[1]) if row is not None and _is_whole(_number(name), *row) else None

    def about(self, name: str, otherwise: str | None = None) -> str:
        """Return what the store tells about itself under a name.

        Raises StoreUnusableError for what is damaged, or gone where it may not be.
        """
        row = self._one("SELECT checksum, value FROM about WHERE name = ?", name)
        if row is None and otherwise is not None:
            return otherwise
        if row is None or not _is_whole(_number(name), row[0], str(row[1]).encode()):
            raise StoreUnusableError(f"its {name} is damaged or gone")
        return str(row[1])

    def tell(self, name: str, value: str) -> None:
        """Let the store tell something about itself; not worth an error."""
        if self._connection is not None:
            with contextlib.suppress(sqlite3.Error):
                row = _about_row(name, value)
                self._connection.execute("REPLACE INTO about VALUES (?, ?, ?)", row)

    def set_aside(self) -> Path:
        """Give the file, its log beside it, the first free name; return it."""
        path, number = self.path, 1
        while (aside := path.with_name(f"{path.stem}.aside-{number}{path.suffix}")).exists():
            number += 1
        path.rename(aside)
        for suffix in ("-wal", "-shm"):
            beside = path.with_name(path.name + suffix)
            if beside.exists():
                beside.rename(aside.with_name(aside.name + suffix))
        return aside

    def all_aside(self) -> list[Path]:
        """Return the files that were set aside so far, their logs among them."""
        return list(self.path.parent.glob(f"{self.path.stem}.aside-*"))

    def close(self) -> None:
        """Let go of the file."""
        if self._connection is not None:
            with contextlib.suppress(sqlite3.Error):
                self._connection.close()
        self._connection = None

    @property
    def _database(self) -> sqlite3.Connection:
        if self._connection is None:
            raise sqlite3.OperationalError("no store")
        return self._connection

    def _connect(self) -> None:
        self._connection = sqlite3.connect(
            self.path, timeout=2.0, isolation_level=None, check_same_thread=False
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
            self.close()
            raise ConfigError(f"{self.path} is in use by another process; end it first") from error

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        database = self._database
        database.execute("BEGIN IMMEDIATE")
        try:
            yield database
            database.execute("COMMIT")
        except BaseException:
            if database.in_transaction:
                database.execute("ROLLBACK")
            raise

    def _one(self, query: str, *values: str) -> tuple[Any, ...] | None:
        if self._connection is None:
            return None
        row: tuple[Any, ...] | None = self._connection.execute(query, values).fetchone()
        return row


def _number(name: str) -> int:
    """Return what takes a number's place in the checksum of a row that has a name."""
    return zlib.crc32(name.encode())


def _about_row(name: str, value: str) -> tuple[str, int, str]:
    return name, zlib.crc32(value.encode(), _number(name)), value


def _is_whole(number: object, checksum: object, body: object) -> bool:
    """Return whether a row is as it was written; what is damaged may be of any type, or NULL."""
    if not (isinstance(number, int) and isinstance(body, bytes)):
        return False
    return zlib.crc32(body, number) == checksum


def is_about_access(error: Exception) -> bool:
    """Return whether the disk or its rights are to blame, not what the file holds."""
    return isinstance(error, sqlite3.OperationalError) and any(
        word in str(error) for word in ("unable to open", "readonly", "full", "disk I/O")
    )
