"""Every byte of a modem's line in a file, and a run of the same core over that file again.

One JSON object per line: t (now_s), way and hex. `in` and `out` are bytes of the line, `send` is a
frame that was queued, `poll` a moment at which the core had something to do or to wait for, `lost`
a port gone.
"""

import itertools
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from protocol.errors import ConfigError
from protocol.modems.dialect_driver import Core
from protocol.modems.events import DialectEvent

WAYS = ("in", "out", "send", "poll", "lost")


@dataclass(frozen=True, slots=True, kw_only=True)
class LogLine:
    """One line of a raw log."""

    t_s: float
    way: str
    data: bytes


class RawLog:
    """A tap that writes to an open text file; hand it to `ModemContext(tap=...)`.

    It ends with the first line that the disk does not take, so that what there is replays as it
    was; the lines from there on are counted in `unwritten`, and the modem goes on.
    """

    def __init__(self, file: TextIO) -> None:
        self._file, self.unwritten = file, 0

    def __call__(self, direction: str, data: bytes, now_s: float) -> None:
        """Write one line, and have it on disk before the modem's next word."""
        if self.unwritten:
            self.unwritten += 1
            return
        line = {"t": now_s, "way": direction, "hex": data.hex()}
        try:
            self._file.write(json.dumps(line) + "\n")
            self._file.flush()
        except OSError:
            self.unwritten += 1


def new_log(path: Path) -> TextIO:
    """Open a log of its own for each life of a driver: the path, or else path.1, path.2 and so on.

    Raises OSError where there can be none.
    """
    later = (path.with_name(f"{path.name}.{life}") for life in itertools.count(1))
    for name in itertools.chain([path], later):
        try:
            return name.open("x", encoding="ascii")
        except FileExistsError:
            continue
    raise AssertionError("there is no last number")


def read_log(lines: Iterable[str]) -> Iterator[LogLine]:
    """Yield the lines of a raw log; a last line that was cut by a crash is left out.

    Raises
    ------
    ConfigError
        For a whole line that is none of a raw log.
    """
    for number, text in enumerate(lines, 1):
        if not text.endswith("\n"):
            return
        try:
            entry = json.loads(text)
            way = str(entry["way"])
            line = LogLine(t_s=float(entry["t"]), way=way, data=bytes.fromhex(entry["hex"]))
        except (ValueError, KeyError, TypeError) as error:
            raise ConfigError(f"line {number} is none of a raw modem log: {error}") from error
        if way not in WAYS:
            raise ConfigError(f"line {number} of the raw modem log: way {way!r}, not in {WAYS}")
        yield line


def replay(lines: Iterable[LogLine], core: Core) -> tuple[list[DialectEvent], bytes, bytes]:
    """Return the events of a core that hears a log again, what it says, and what was said then.

    A core made with the settings of the recorded one says the same, byte for byte.
    """
    events: list[DialectEvent] = []
    said, recorded = bytearray(), bytearray()
    for line in lines:
        match line.way:
            case "in":
                core.receive_data(line.data, line.t_s)
            case "send":
                core.send(line.data, line.t_s)
            case "poll":
                core.next_wakeup_s(line.t_s)  # as its driver asks, which plans what waits
                said += core.poll(line.t_s)
            case "lost":
                core.lost(line.t_s)
            case _:
                recorded += line.data
        while (event := core.next_event()) is not None:
            events.append(event)
    return events, bytes(said), bytes(recorded)
