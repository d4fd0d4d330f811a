"""From the pings of a multibeam sonar to soundings in NED."""

import math
from dataclasses import dataclass

import numpy as np

from firmware.geometry import Array, rotation_ned_body
from protocol.packets import DEEPEST_M, HIGHEST_M
from protocol.settings import Settings, setting


@dataclass(frozen=True, slots=True, kw_only=True)
class Ping:
    """One ping of the multibeam sonar, with the attitude and depth measured at that instant.

    slant_ranges_m and beam_angles_rad are (B,); a lost beam is NaN. Angles are from the body's
    vertical, positive to starboard.
    """

    time_s: float
    slant_ranges_m: Array
    beam_angles_rad: Array
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    depth_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Fix:
    """An absolute position in NED, of the leader (0) by GNSS, or by USBL of any vehicle."""

    vehicle: int = 0
    north_m: float
    east_m: float
    sigma_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Odometry:
    """The velocity over ground (Doppler log in the attitude reference), in NED, at one instant.

    With it comes the fix of that instant, if there is one; followers make no use of theirs, because
    what they send is raw dead reckoning.
    """

    time_s: float
    velocity_north_mps: float
    velocity_east_mps: float
    yaw_rad: float
    depth_m: float
    fix: Fix | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SonarSettings(Settings):
    """Where the sonar sits, and which ranges it can be believed at."""

    lever_forward_m: float = setting(
        0.0, "m", "sonar ahead of the navigation reference point", minimum=-20.0, maximum=20.0
    )
    lever_starboard_m: float = setting(
        0.0, "m", "sonar to starboard of it", minimum=-20.0, maximum=20.0
    )
    lever_down_m: float = setting(0.0, "m", "sonar below it", minimum=-20.0, maximum=20.0)
    minimum_range_m: float = setting(
        1.0, "m", "nearer echoes are the vehicle's own", minimum=0.0, maximum=1000.0
    )
    maximum_range_m: float = setting(
        500.0, "m", "farther than a 120 degree swath at 250 m altitude", minimum=1.0
    )


def soundings_from_ping(
    ping: Ping, north_m: float, east_m: float, settings: SonarSettings
) -> tuple[Array, int]:
    """Return the soundings of a ping (N, 3) as north, east, depth, and the count of bad beams.

    The beam (0, sin a, cos a) r of the body plus the lever arm is turned into NED and added to the
    vehicle's position. Lost, non-finite and out-of-range beams are left out and counted, and all of
    a ping from a depth that no vehicle has.
    Source: paper, section 3 (X_MP and h_MP of a measured point).
    """
    ranges_m = np.asarray(ping.slant_ranges_m, dtype=np.float64)
    angles_rad = np.asarray(ping.beam_angles_rad, dtype=np.float64)
    pose = (ping.roll_rad, ping.pitch_rad, ping.yaw_rad, ping.depth_m, north_m, east_m)
    is_somewhere = all(map(math.isfinite, pose)) and HIGHEST_M <= ping.depth_m <= DEEPEST_M
    if ranges_m.ndim != 1 or ranges_m.shape != angles_rad.shape or not is_somewhere:
        return np.empty((0, 3)), ranges_m.size
    with np.errstate(invalid="ignore"):
        good = (
            (ranges_m >= settings.minimum_range_m)
            & (ranges_m <= settings.maximum_range_m)
            & (np.abs(angles_rad) < np.pi / 2)
        )
    ranges_m, angles_rad = ranges_m[good], angles_rad[good]
    body_m = np.empty((ranges_m.size, 3))
    body_m[:, 0] = settings.lever_forward_m
    body_m[:, 1] = ranges_m * np.sin(angles_rad) + settings.lever_starboard_m
    body_m[:, 2] = ranges_m * np.cos(angles_rad) + settings.lever_down_m
    rotation = rotation_ned_body(ping.roll_rad, ping.pitch_rad, ping.yaw_rad)
    soundings_ned_m = body_m @ rotation.T + (north_m, east_m, ping.depth_m)
    return soundings_ned_m, int(good.size - np.count_nonzero(good))
