"""The header's two short times, and how a receiver finds the full ones again."""

import math

QUARTERS_MODULO = 1 << 20
TX_SECONDS_MODULO = 16
EARLY_S = 0.5
"""A measured arrival may precede the transmission by noise; half a second bounds any clock."""

_AHEAD_S = 1.0  # an arrival farther ahead of our clock is a modem's error
_LONGEST_RECEPTION_S = 60.0  # until a frame is handed over: it sounds for 51 s at 40 bit/s


def to_quarters(time_s: float) -> int:
    """Return the mission time in quarter seconds, modulo 2**20 (72.8 h), to the nearest."""
    return round(time_s * 4.0) % QUARTERS_MODULO


def from_quarters(time_quarters: int, near_s: float) -> float:
    """Return the mission time closest to `near_s` that has this remainder; right within 36 h."""
    turn_s = QUARTERS_MODULO / 4.0
    time_s = time_quarters / 4.0
    return time_s + turn_s * round((near_s - time_s) / turn_s)


def to_tx_second(tx_s: float) -> int:
    """Return the whole second of a transmission, modulo 16."""
    return math.floor(tx_s) % TX_SECONDS_MODULO


def transmission_s(tx_second: int, toa_s: float) -> float:
    """Return the latest whole second before the arrival that has this remainder.

    Unambiguous while the travel time stays under 15.5 s, 23 km at 1500 m/s.
    """
    latest_s = toa_s + EARLY_S
    return tx_second + TX_SECONDS_MODULO * math.floor((latest_s - tx_second) / TX_SECONDS_MODULO)


def is_arrival(toa_s: float, now_s: float) -> bool:
    """Return whether a frame that is handed over now can have begun to arrive at a time."""
    return -_AHEAD_S <= now_s - toa_s <= _LONGEST_RECEPTION_S


def one_way_travel_time_s(tx_second: int, toa_s: float) -> float:
    """Return arrival minus transmission; noise may make it a little negative at short range."""
    return toa_s - transmission_s(tx_second, toa_s)
