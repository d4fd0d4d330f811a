"""What the vehicles tell each other: one frozen dataclass per packet; WIRE.md has the bytes."""

import enum
import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from protocol.errors import LocalProtocolError

VERSION = 1
"""Of the layout; WIRE.md lists the fingerprint of every version's table."""

Array32 = NDArray[np.float32]

FARTHEST_M = 1.0e6
"""A coordinate beyond this from the mission datum is damage or malice, never a survey."""
HIGHEST_M, DEEPEST_M = -100.0, 12_000.0
"""Depths outside are absurd: positive down, the deepest trench is 10,935 m."""


SMALLEST_SIGMA_M, SIGMA_STEPS = 0.1, 16
"""An answer tells its sigma in sixteenths of an octave above 0.1 m."""


class Profile(enum.IntEnum):
    """The five bits of the header that say what a frame holds; sealed profiles have bit 4 set."""

    SUBMAP_PAPER = 1
    ANSWER = 2
    TRAJECTORY = 3
    SUBMAP_DENSE = 4
    SUBMAP_LATTICE = 5
    SUBMAP_LATTICE_SMALL = 6
    ANSWER_EXTENDED = 7
    TRAJECTORY_SMALL = 8
    SEALED_SUBMAP_PAPER = 17
    SEALED_ANSWER = 18
    SEALED_TRAJECTORY = 19
    SEALED_SUBMAP_DENSE = 20
    SEALED_SUBMAP_LATTICE = 21
    SEALED_SUBMAP_LATTICE_SMALL = 22
    SEALED_ANSWER_EXTENDED = 23
    SEALED_TRAJECTORY_SMALL = 24

    @property
    def is_sealed(self) -> bool:
        """Whether frames of this profile carry a counter and a tag."""
        return self >= SEALED

    @property
    def sealed(self) -> "Profile":
        """The sealed profile of the same content."""
        return Profile(self | SEALED)

    @property
    def plain(self) -> "Profile":
        """The profile of the same content without seal."""
        return Profile(self & ~SEALED)


SEALED = 16
HEADER_BYTES, CRC_BYTES, SEAL_BYTES = 8, 4, 12
SMALL_FRAME_BYTES, FRAME_BYTES = 62, 256

BODY_BYTES: dict[Profile, int] = {
    Profile.SUBMAP_PAPER: 244,
    Profile.ANSWER: 10,
    Profile.TRAJECTORY: 244,
    Profile.SUBMAP_DENSE: 244,
    Profile.SUBMAP_LATTICE: 244,
    Profile.SUBMAP_LATTICE_SMALL: 50,
    Profile.ANSWER_EXTENDED: 30,
    Profile.TRAJECTORY_SMALL: 50,
    Profile.SEALED_SUBMAP_PAPER: 232,
    Profile.SEALED_ANSWER: 10,
    Profile.SEALED_TRAJECTORY: 232,
    Profile.SEALED_SUBMAP_DENSE: 232,
    Profile.SEALED_SUBMAP_LATTICE: 232,
    Profile.SEALED_SUBMAP_LATTICE_SMALL: 38,
    Profile.SEALED_ANSWER_EXTENDED: 30,
    Profile.SEALED_TRAJECTORY_SMALL: 38,
}
"""Bytes between the header and the counter (sealed) or the CRC."""

SIZE_BYTES: dict[Profile, int] = {
    profile: HEADER_BYTES + body + (SEAL_BYTES if profile.is_sealed else 0) + CRC_BYTES
    for profile, body in BODY_BYTES.items()
}
"""Of the whole frame; a frame of any other size is rejected."""

OPAQUE: frozenset[int] = frozenset(
    {Profile.SUBMAP_DENSE, Profile.SUBMAP_LATTICE, Profile.SUBMAP_LATTICE_SMALL}
)
"""Profiles whose body only `firmware.compression` reads."""

STATES_PER_FRAGMENT = 4
POINTS_PER_FRAGMENT, POINTS_PER_SEALED_FRAGMENT = 15, 14
MAX_FRAGMENTS = 15
"""Four bits count the fragments of a transfer."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Header:
    """The first 64 bits of every frame.

    `vehicle` and `boot_epoch` are always the sender's. tx_second is the whole second of the shared
    clock, modulo 16, at which the first bit left; time_quarters counts quarter seconds of mission
    time, modulo 2**20 (72.8 h), see `protocol.timestamps`.

    In fragments of a sub-map, submap, fragment (from 0) and fragment_count say which part of what
    this is, and time_quarters is the time of the body's first state. In a trajectory packet, submap
    counts such packets and fragment_count is 1. In an answer, submap holds the code of its sigma
    and a count (see `answer_count`), in an extended one just a count; fragment is the vehicle
    addressed and fragment_count the boot epoch of the sub-map answered.
    """

    profile: Profile
    vehicle: int
    boot_epoch: int
    submap: int
    fragment: int
    fragment_count: int
    tx_second: int
    time_quarters: int
    version: int = VERSION

    def __post_init__(self) -> None:
        if (
            self.version >> 3
            or self.profile >> 5
            or self.vehicle >> 4
            or self.boot_epoch >> 4
            or self.submap >> 16
            or self.fragment >> 4
            or self.fragment_count >> 4
            or self.tx_second >> 4
            or self.time_quarters >> 20
        ):
            raise LocalProtocolError(f"{self} has a field that does not fit its bits; see WIRE.md")


class _BitwiseEqual:
    """Equality of packets by header and exact bytes, so that NaN equals NaN."""

    __slots__ = ()

    def _key(self) -> tuple[object, ...]:
        values = (getattr(self, field.name) for field in fields(self))  # type: ignore[arg-type]
        return tuple(v.tobytes() if isinstance(v, np.ndarray) else v for v in values)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _BitwiseEqual) or type(other) is not type(self):
            return NotImplemented
        return self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())


def usable_states(states: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return (T,) which of the states (T, 3) north, east, yaw mean something."""
    near = np.abs(states[:, :2]) <= FARTHEST_M
    return np.asarray(np.isfinite(states).all(axis=1) & near.all(axis=1))


def usable_points(points_ned_m: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return (M,) which of the points (M, 3) north, east, depth are within any survey's bounds."""
    near = np.abs(points_ned_m[:, :2]) <= FARTHEST_M
    depth_m = points_ned_m[:, 2]
    return np.asarray(near.all(axis=1) & (depth_m >= HIGHEST_M) & (depth_m <= DEEPEST_M))


def usable_hyperparameters(hyperparameters: NDArray[np.floating]) -> bool:
    """Return whether hyperparameters (4,) mean something."""
    b, c, _, mean_depth_m = hyperparameters.tolist()
    is_finite = bool(np.isfinite(hyperparameters).all())
    return is_finite and b != 0.0 and c != 0.0 and HIGHEST_M <= mean_depth_m <= DEEPEST_M


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SubmapPacket(_BitwiseEqual):
    """One of the paper's ten packets: a slice of trajectory, 15 pseudo points, hyperparameters.

    trajectory is (4, 3) float32: north_m, east_m, yaw_rad in raw dead reckoning, one state a second
    from the header's time; NaN where there is none. points_ned_m is (15, 3) float32 (14 rows in a
    sealed frame): north, east, depth; NaN where there is none. hyperparameters is (4,) float32: b,
    c, sigma2_m2, mean depth_m, the same in all fragments; signs tell the kernel, see WIRE.md.
    """

    header: Header
    trajectory: Array32
    points_ned_m: Array32
    hyperparameters: Array32


@dataclass(frozen=True, slots=True, kw_only=True)
class SubmapFragment:
    """A fragment of a `dense` or `lattice` sub-map; `firmware.compression` reads the body.

    The body has 244 bytes, 50 in the small size, and 12 fewer when sealed.
    """

    header: Header
    body: bytes


Fragment = SubmapPacket | SubmapFragment
"""Of a sub-map, whatever its profile."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrajectoryPacket(_BitwiseEqual):
    """A stretch of trajectory alone, sent after the survey.

    states is (20, 3) float32, (19, 3) sealed, (4, 3) small, (3, 3) small and sealed: north_m,
    east_m, yaw_rad in raw dead reckoning, one a second from the header's time; NaN unused.
    """

    header: Header
    states: Array32


@dataclass(frozen=True, slots=True, kw_only=True)
class _AnyAnswer:
    """What both answers tell, and to whom."""

    header: Header
    submap: int
    north_m: float
    east_m: float

    @property
    def to_vehicle(self) -> int:
        """The vehicle that this answer is for."""
        return self.header.fragment

    @property
    def to_boot_epoch(self) -> int:
        """The boot epoch of that vehicle in which it numbered the sub-map."""
        return self.header.fragment_count


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer(_AnyAnswer):
    """The leader's estimate of a follower's position at the header's time.

    `submap` is the sub-map answered; the header's fragment is the vehicle addressed and its
    fragment_count the boot epoch in which that vehicle numbered the sub-map. The header's submap
    is `answer_count` of the sigma and of how many answers were sent before.
    """

    @property
    def sigma_m(self) -> float | None:
        """The standard deviation of the position along each axis; None if it is not told."""
        code = self.header.submap >> 8
        return SMALLEST_SIGMA_M * 2.0 ** ((code - 1) / SIGMA_STEPS) if code else None


def answer_count(sigma_m: float, sent: int) -> int:
    """Return the header's submap of an answer: sigma in the high byte, a count in the low one.

    The sigma is rounded up to the next of 255 steps of 4 % between 0.1 m and 6 km.
    """
    steps = SIGMA_STEPS * math.log2(max(sigma_m, SMALLEST_SIGMA_M) / SMALLEST_SIGMA_M)
    return (min(1 + math.ceil(steps - 1e-9), 255) << 8) | (sent % 256)


@dataclass(frozen=True, slots=True, kw_only=True)
class ExtendedAnswer(_AnyAnswer):
    """An answer with its variance, the leader's own position, and what is to be repeated.

    Variances are per horizontal axis in square metres; the leader's position is that at
    transmission. Bit i of missing_fragments asks for fragment i of repeat_submap; 0 asks nothing.
    """

    variance_m2: float
    leader_north_m: float
    leader_east_m: float
    leader_variance_m2: float
    repeat_submap: int
    missing_fragments: int

    @property
    def sigma_m(self) -> float:
        """The standard deviation of the position along each axis."""
        return math.sqrt(self.variance_m2)


@dataclass(frozen=True, slots=True, kw_only=True)
class SealedFrame:
    """A frame whose content may be read only after its tag was verified; see `protocol.seal`."""

    header: Header
    body: bytes
    counter: int
    tag: bytes


Packet = Fragment | TrajectoryPacket | Answer | ExtendedAnswer | SealedFrame
