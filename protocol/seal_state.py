"""What sealing keeps on disk: the key file, counters reserved ahead, and marks of what was seen."""

import json
import os
import stat
from pathlib import Path

from protocol.errors import ConfigError, LocalProtocolError
from protocol.seal import KEY_BYTES, LARGEST_COUNTER, Keys

RESERVED_AHEAD = 1024
"""Counters per write to disk: one write an hour at the paper's rate, 1e6 restarts until the end."""
LARGEST_FILE_BYTES = 4096
"""Cap of every file read here; none of ours is longer."""


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


class ReservedCounter:
    """Counters reserved on disk before use, so that a crash skips some but never repeats one."""

    def __init__(self, path: Path, ahead: int = RESERVED_AHEAD) -> None:
        self._path, self._ahead = path, ahead
        self._next = self._reserved = self._load()

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
            write_durably(self._path, f"{reserved}\n")
        except OSError as error:
            raise LocalProtocolError(f"no counters reserved in {self._path}: {error}") from error
        self._reserved = reserved

    def _load(self) -> int:
        try:
            text = _read(self._path)
        except FileNotFoundError:
            return 0
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"counter file {self._path} cannot be read: {error}") from error
        if not text.strip().isdecimal() or not 0 <= int(text) <= LARGEST_COUNTER:
            raise ConfigError(
                f"counter file {self._path} is damaged; counters must never repeat: delete it"
                " and change the key on all vehicles"
            )
        return int(text)


class FileMarks:
    """The highest counters accepted, by sender; a receiver that restarts refuses older ones."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.failed_writes = 0

    def load(self) -> dict[int, int]:
        """Return the marks; none when the file is not there yet."""
        try:
            text = _read(self._path)
        except FileNotFoundError:
            return {}
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"{self._path} cannot be read: {error}") from error
        try:
            return {int(sender): int(mark) for sender, mark in json.loads(text).items()}
        except (ValueError, TypeError, AttributeError) as error:
            raise ConfigError(f"{self._path} is damaged ({error}); delete it") from error

    def save(self, marks: dict[int, int]) -> None:
        """Keep the marks; a disk that refuses is counted, the link goes on."""
        try:
            write_durably(self._path, json.dumps(marks))
        except OSError:
            self.failed_writes += 1


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
