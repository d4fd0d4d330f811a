"""What sealing keeps on disk: the key file, counters reserved ahead, and marks of what was seen."""

import json
import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Protocol, TypeVar

from protocol.errors import ConfigError, LocalProtocolError
from protocol.seal import KEY_BYTES, LARGEST_COUNTER, Keys

RESERVED_AHEAD = 64
"""Counters per write to disk: one write in four minutes; restarts once a minute outrun no clock."""
LARGEST_FILE_BYTES = 4096
"""Cap of every file read here; none of ours is longer."""

T = TypeVar("T")


def load_keys(path: Path) -> Keys:
    """Return the keys of a file with 64 hexadecimal digits that its owner alone may read.

    Raises
    ------
    ConfigError
        When the file is not there, open to others, or holds anything else.
    """
    advice = f"make one with: (umask 077; openssl rand -hex {KEY_BYTES} > {path})"
    try:
        mode = stat.S_IMODE(path.stat().st_mode)
        text = _read(path)
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"key file {path} cannot be read ({error}); {advice}") from error
    if mode & 0o077:
        raise ConfigError(f"key file {path} has mode {mode:04o}; type: chmod 600 {path}")
    digits = text.strip()
    if len(digits) != 2 * KEY_BYTES or not all(c in "0123456789abcdefABCDEF" for c in digits):
        raise ConfigError(
            f"key file {path} holds {len(digits)} characters, not {2 * KEY_BYTES} hexadecimal"
            f" digits; {advice}"
        )
    return Keys(bytes.fromhex(digits))


class Files(Protocol):
    """The disk under counters and marks; handed in, so that a fault can be."""

    def read(self, path: Path) -> str:
        """Return a small file's text; raises OSError, or UnicodeDecodeError for damage."""

    def write(self, path: Path, text: str) -> None:
        """Write a small file so that power loss leaves the old text or the new."""


class Disk:
    """The computer's own files."""

    def read(self, path: Path) -> str:
        """Return a small file's text."""
        return _read(path)

    def write(self, path: Path, text: str) -> None:
        """Write durably."""
        write_durably(path, text)


DISK = Disk()


class ReservedCounter:
    """Counters reserved on disk before use, so that a crash skips some but never repeats one.

    They are kept twice, and a restart takes the higher of what it can read: one damaged file stops
    nobody. A store that is lost whole begins at `floor`: seconds of a clock, which runs ahead of
    any sender with less than a frame a second.
    """

    def __init__(
        self, path: Path, ahead: int = RESERVED_AHEAD, floor: int = 0, files: Files = DISK
    ) -> None:
        self._path, self._ahead, self._files = path, ahead, files
        self._next = self._reserved = max(self._load(), floor)

    def next(self) -> int:
        """Return the next number.

        Raises
        ------
        LocalProtocolError
            When no more can be reserved: the disk is full or gone, or the key has to be changed.
        """
        if self._next == self._reserved:
            self._reserve()
        number = self._next
        self._next += 1
        return number

    def _reserve(self) -> None:
        reserved = self._reserved + self._ahead
        if reserved > LARGEST_COUNTER:
            raise LocalProtocolError(f"counters in {self._path} are used up; change the key")
        try:
            for path in _twice(self._path):
                self._files.write(path, f"{reserved}\n")
        except OSError as error:
            raise LocalProtocolError(f"no counters reserved in {self._path}: {error}") from error
        self._reserved = reserved

    def _load(self) -> int:
        numbers = _readable(self._path, self._files, _counter)
        if numbers is None:
            raise ConfigError(
                f"counter file {self._path} is damaged, and its copy; counters must never repeat:"
                " delete both and change the key on all vehicles"
            )
        return max(numbers, default=0)


class FileMarks:
    """The highest counters accepted, by sender; a receiver that restarts refuses older ones."""

    def __init__(self, path: Path, files: Files = DISK) -> None:
        self._path, self._files = path, files
        self.failed_writes = 0

    def load(self) -> dict[int, int]:
        """Return the marks, the higher ones of file and copy; none when there is no file yet."""
        kept = _readable(self._path, self._files, _marks)
        if kept is None:
            raise ConfigError(f"{self._path} is damaged, and its copy; delete both")
        highest: dict[int, int] = {}
        for marks in kept:
            for sender, mark in marks.items():
                highest[sender] = max(mark, highest.get(sender, mark))
        return highest

    def save(self, marks: dict[int, int]) -> None:
        """Keep the marks; a disk that refuses is counted, the link goes on."""
        try:
            for path in _twice(self._path):
                self._files.write(path, json.dumps(marks))
        except OSError:
            self.failed_writes += 1


def _twice(path: Path) -> tuple[Path, Path]:
    return path, path.with_name(path.name + ".copy")


def _readable(path: Path, files: Files, parse: Callable[[str], T]) -> list[T] | None:
    """Return what file and copy hold, as far as they can be read; None when none of them can."""
    found, damaged = [], 0
    for each in _twice(path):
        try:
            found.append(parse(files.read(each)))
        except FileNotFoundError:
            continue
        except (OSError, ValueError, TypeError, AttributeError, OverflowError, RecursionError):
            damaged += 1
    return None if damaged and not found else found


def _counter(text: str) -> int:
    if not text.strip().isdecimal() or int(text) > LARGEST_COUNTER:
        raise ValueError(text)
    return int(text)


def _marks(text: str) -> dict[int, int]:
    return {int(sender): int(mark) for sender, mark in json.loads(text).items()}


def write_durably(path: Path, text: str) -> None:
    """Write a small file so that power loss at any instant leaves the old or the new content."""
    temporary = path.with_name(path.name + ".new")
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    try:
        os.write(descriptor, text.encode())
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
    os.replace(temporary, path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def _read(path: Path) -> str:
    with path.open("rb") as file:
        return file.read(LARGEST_FILE_BYTES).decode()
