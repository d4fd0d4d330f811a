"""The seal of a vehicle's process: key file, and counters and marks in its store."""

import dataclasses
import time
from pathlib import Path

from host_tools.processes.voyage import Voyage
from protocol.errors import ConfigError
from protocol.modems.sealed import SealedLink
from protocol.seal import Blake2sSuite, Opener, Sealer, Suite
from protocol.seal_state import FileMarks, ReservedCounter, load_keys
from protocol.settings import replace

COUNTER_ZERO_UTC_S = 1_735_689_600
"""2025-01-01: counters of a store without any begin at the seconds since then; 32 bits last."""


def seal_of(vehicle: int, key: Path, store: Path | None, *, encrypts: bool = False) -> SealedLink:
    """Return the seal of a vehicle; one that encrypts hides what frames say.

    Raises
    ------
    ConfigError
        For a key file that cannot be used, without a store: counters must outlive a crash; and
        for encryption where its library is not installed, or the clock stands before 2025.
    """
    keys = load_keys(key)
    if store is None:
        raise ConfigError("--key needs --store DIR: seal counters must survive a restart")
    floor = max(0, int(time.clock_gettime(time.CLOCK_REALTIME)) - COUNTER_ZERO_UTC_S)
    if encrypts and floor == 0:
        raise ConfigError(
            "--encrypt needs the right time of day, and this clock stands before 2025: set it, "
            "or counters of a store that was lost would repeat"
        )
    counter = ReservedCounter(store / f"seal_{vehicle}.counter", floor=floor)
    marks = FileMarks(store / f"seal_{vehicle}.marks")
    suite = _aes() if encrypts else Blake2sSuite()
    return SealedLink(Sealer(keys, counter, suite), Opener(vehicle, keys, marks, suite))


def _aes() -> Suite:
    from protocol.seal_aes import AesCcmSuite  # noqa: PLC0415  (needs an extra)

    return AesCcmSuite()


def sealed_voyage(voyage: Voyage) -> Voyage:
    """Return the voyage with sub-maps that leave a seal its place."""
    changes = {
        "follower.compression.parity": False,
        "follower.compression.sealed": True,
        "leader.reconstruction.sealed": True,
    }
    return dataclasses.replace(voyage, settings=replace(voyage.settings, changes))
