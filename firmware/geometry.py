"""Angles and rotations of the body frame (forward, starboard, down) in NED."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def wrap_angle(angle_rad: Array | float) -> Array:
    """Return the angle in [-pi, pi)."""
    return (np.asarray(angle_rad, dtype=np.float64) + np.pi) % (2.0 * np.pi) - np.pi


def offset_covariance(joint: Array) -> Array:
    """Return the covariance (2, 2) of the way between two points from their joint one (4, 4)."""
    here, there = slice(2), slice(2, 4)
    return joint[here, here] + joint[there, there] - joint[here, there] - joint[there, here]


def rotation_ned_body(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Array:
    """Return the (3, 3) matrix that takes body vectors to NED (yaw, then pitch, then roll)."""
    cr, sr = np.cos(roll_rad), np.sin(roll_rad)
    cp, sp = np.cos(pitch_rad), np.sin(pitch_rad)
    cy, sy = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
