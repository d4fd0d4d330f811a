"""What the paper compares with: unlimited communication, and octrees lost with any packet.

The same frames travel, with the same losses and delays; a baseline changes only what the leader
makes of a transfer. The originals come from a second sub-map builder beside each follower.
"""

from dataclasses import dataclass

from firmware.dead_reckoning import DeadReckoning
from firmware.follower.core import FollowerCore
from firmware.follower.settings import FollowerSettings
from firmware.leader.arrivals import Rebuild
from firmware.leader.own_grid import grid_of
from firmware.leader.reconstruction import Reconstruction
from firmware.soundings import Odometry, Ping
from firmware.submap_builder import SubmapBuilder
from firmware.submaps import Submap
from host_tools.nodes import Node, Steps
from host_tools.octree import decode_octree, octree_submap
from protocol.acoustics import Delivery
from protocol.codec import decode
from protocol.errors import ConfigError, EstimationError
from protocol.packets import Fragment
from protocol.reassembly import Key, SubmapTransfer
from protocol.vehicles import LEADER

HEARD = ("delivered", "duplicate")
MOST_CHUNKS = 10  # a sub-map's share of the air


@dataclass(slots=True)
class Originals:
    """The followers' sub-maps as measured, by vehicle, boot epoch and number."""

    submaps: dict[Key, Submap]

    def of(self, transfer: SubmapTransfer) -> Submap:
        """Return the sub-map that a transfer carries.

        Raises
        ------
        EstimationError
            When no such sub-map was measured.
        """
        key = (transfer.vehicle, transfer.boot_epoch, transfer.submap)
        if key not in self.submaps:
            raise EstimationError(f"sub-map {key} was never measured")
        return self.submaps[key]


def copied_steps(
    steps: Steps, core: FollowerCore, settings: FollowerSettings, originals: Originals
) -> Steps:
    """Yield a follower's steps unchanged, and keep the sub-maps that they make in originals."""
    reckoning = DeadReckoning(core.reckoned)
    builder = SubmapBuilder(
        core.vehicle,
        core.boot_epoch,
        settings=settings.submaps,
        sonar=settings.sonar,
        binning=settings.binning,
    )
    for odometry, ping in steps:
        submap = _follow(reckoning, builder, odometry, ping)
        if submap is not None:
            originals.submaps[(submap.vehicle, submap.boot_epoch, submap.index)] = submap
        yield odometry, ping


def _follow(
    reckoning: DeadReckoning, builder: SubmapBuilder, odometry: Odometry, ping: Ping | None
) -> Submap | None:
    state = reckoning.receive_odometry(odometry)
    builder.receive_state(state)
    submap = builder.take()
    if ping is not None:
        builder.receive_ping(ping, state)
    return submap


def unlimited(originals: Originals, cell_m: float) -> Rebuild:
    """Return a way to rebuild that gives every sub-map as measured, whatever was lost of it."""

    def rebuild(transfer: SubmapTransfer) -> Reconstruction:
        submap = originals.of(transfer)
        return Reconstruction(grid=grid_of(submap.bins, cell_m), track=submap.track)

    return rebuild


class Unheard:
    """Hands to the leader, with the last frame of a sub-map, what it missed where that was most.

    Otherwise the leader would not know that there is such a sub-map, or where it lies. No ranges
    come with frames that nobody heard. It is told of every delivery in turn, and holds the
    missed frames of one sub-map of each follower.
    """

    def __init__(self, leader: Node) -> None:
        self._leader = leader
        self._newest: dict[int, tuple[Key, list[bytes]]] = {}

    def note(self, delivery: Delivery) -> None:
        """Take what became of a frame at a receiver."""
        if delivery.sent is None:
            return
        packet = decode(delivery.sent)
        if delivery.destination != LEADER or not isinstance(packet, Fragment):
            return
        header = packet.header
        key = (header.vehicle, header.boot_epoch, header.submap)
        newest, lost = self._newest.get(delivery.source, (None, []))
        if newest != key:
            lost = []
            self._newest[delivery.source] = key, lost
        if delivery.fate not in HEARD:
            lost.append(delivery.sent)
        is_last = header.fragment == header.fragment_count - 1
        if is_last and 2 * len(lost) > header.fragment_count:
            for frame in lost:
                self._leader.hear(frame, None, delivery.t_delivered_s)


def octree(originals: Originals) -> Rebuild:
    """Return a way to rebuild that gives the octree, or nothing if one of its packets was lost.

    The tree's chunks ride in the first fragments of the transfer; one that needs more than ten is
    lost too: there is no air for it.
    """

    def rebuild(transfer: SubmapTransfer) -> Reconstruction:
        submap = originals.of(transfer)
        chunks = octree_submap(submap.bins)
        if not chunks or len(chunks) > MOST_CHUNKS:
            raise EstimationError(f"an octree of {len(chunks)} packets has no air to travel in")
        lost = [k for k in range(len(chunks)) if k not in transfer.fragments]
        if lost:
            raise EstimationError(f"packets {lost} of an octree were lost, and it with them")
        return Reconstruction(grid=decode_octree(chunks, submap.track), track=submap.track)

    return rebuild


def rebuild_of(baseline: str, originals: Originals, cell_m: float) -> Rebuild | None:
    """Return the leader's way to rebuild under a baseline, None for its own.

    Raises
    ------
    ConfigError
        For an unknown baseline.
    """
    match baseline:
        case "none":
            return None
        case "unlimited":
            return unlimited(originals, cell_m)
        case "octree":
            return octree(originals)
    raise ConfigError(f"no baseline {baseline!r}; known are none, unlimited and octree")
