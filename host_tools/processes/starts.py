"""When a mission on the wall clock starts, for a vehicle and for its later lives."""

import contextlib
import datetime
import math
import time
from pathlib import Path

from protocol.errors import ConfigError
from protocol.seal_state import write_durably
from protocol.vehicles import name_of

NEXT = "next"


def start_time_s(text: str) -> float:
    """Return UTC seconds of a time such as 2026-05-01T12:00:00Z, or of the next whole minute.

    Raises
    ------
    ConfigError
        For a text that is no time, or one that is no whole second.
    """
    if text == NEXT:
        return 60.0 * math.ceil(time.clock_gettime(time.CLOCK_REALTIME) / 60.0)
    try:
        moment = datetime.datetime.fromisoformat(text)
    except ValueError as error:
        raise ConfigError(f"--start is {text!r}; give UTC, such as 2026-05-01T12:00:00Z") from error
    if moment.microsecond:
        raise ConfigError(f"--start is {text!r}; transmissions need a whole second")
    return (moment if moment.tzinfo else moment.replace(tzinfo=datetime.UTC)).timestamp()


def lasting_start_s(store: Path, vehicle: int, next_s: float, duration_s: float) -> float:
    """Return the start, in UTC seconds, that a store's first life took as the next one.

    Another mission begins where that one is over by the next start, next_s, or nobody can tell.
    """
    path = store / f"{name_of(vehicle)}.start"
    with contextlib.suppress(OSError, ValueError):
        kept_s = float(path.read_text(encoding="ascii"))
        if 0.0 <= next_s - kept_s <= duration_s:
            return kept_s
    with contextlib.suppress(OSError):
        write_durably(path, f"{next_s}\n")
    return next_s
