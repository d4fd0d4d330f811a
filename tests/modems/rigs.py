"""Cores on emulated modems in virtual time, as the tests of this room want them."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from host_tools.emulators.bench import Bench
from host_tools.emulators.micromodem import MicroModemUnit
from host_tools.emulators.micromodem_firmware import MicroModemQuirks
from host_tools.emulators.nanomodem import NanomodemQuirks, NanomodemUnit
from host_tools.emulators.rig import Rig
from protocol.acoustics import Position, Water, WaterSettings
from protocol.modems.micromodem import MicroModem
from protocol.modems.micromodem_settings import MicroModemSettings
from protocol.modems.nanomodem import Nanomodem
from protocol.modems.nanomodem_states import NanomodemSettings

CALM = WaterSettings(loss=0.0, range_noise_m=0.0, outlier_share=0.0)
READY_S = 15.0


def apart(range_m: float) -> Callable[[int, float], Position]:
    return lambda node, _: (range_m * (node - 1), 0.0, 0.0)


def micro_rig(
    *,
    range_m: float = 600.0,
    water: WaterSettings = CALM,
    quirks: MicroModemQuirks | None = None,
    settings: MicroModemSettings | None = None,
    pulse_present: bool = True,
    seed: int = 1,
) -> Rig:
    """Two Micro-Modems, configured and idle at READY_S."""
    medium = Water(water, np.random.default_rng(seed), apart(range_m), nodes=(1, 2))
    units = {n: MicroModemUnit(n, quirks, pulse_present=pulse_present) for n in (1, 2)}
    base = settings or MicroModemSettings()
    cores = {n: MicroModem(replace(base, address=n)) for n in (1, 2)}
    rig = Rig(Bench(medium, units), cores)
    rig.run_until(READY_S)
    return rig


def nano_rig(
    *,
    range_m: float = 600.0,
    water: WaterSettings = CALM,
    quirks: NanomodemQuirks | None = None,
    settings: Callable[[int], NanomodemSettings] = lambda n: NanomodemSettings(address=n),
    seed: int = 1,
) -> Rig:
    """Two Nanomodems, addressed and idle at READY_S."""
    medium = Water(water, np.random.default_rng(seed), apart(range_m), nodes=(1, 2))
    units = {n: NanomodemUnit(n, quirks) for n in (1, 2)}
    rig = Rig(Bench(medium, units), {n: Nanomodem(settings(n)) for n in (1, 2)})
    rig.run_until(READY_S)
    return rig
