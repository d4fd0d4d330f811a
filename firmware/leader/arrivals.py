"""What arrives from followers: states for their tracks at once, sub-maps once they are complete."""

from collections import Counter
from collections.abc import Callable, Iterator

import numpy as np

from firmware.leader.answers import Answers
from firmware.leader.atlas import Sheet, SheetId, sheet_of
from firmware.leader.fleet import Fleet
from firmware.leader.pose_graph import PoseGraph
from firmware.leader.reconstruction import (
    Reconstruction,
    ReconstructionSettings,
    reconstruct_packets,
    states_of_fragment,
)
from firmware.submaps import Track
from protocol.errors import EstimationError
from protocol.packets import Fragment, Header, SubmapPacket, TrajectoryPacket
from protocol.reassembly import FragmentArrived, Reassembler, SubmapTransfer
from protocol.timestamps import from_quarters

_OFF_TRACK_M = 5.0  # a sub-map's own states are those of the track, to the wire's quantisation
_RANGE_WINDOW_S = 20.0  # five frames: enough to tell true ranges from stretched ones together
Rebuild = Callable[[SubmapTransfer], Reconstruction]
"""How a sub-map is made of what arrived of it; raises EstimationError when it cannot be."""


class Arrivals:
    """Packets of followers in; the fleet's tracks grow, sheets come out."""

    def __init__(
        self,
        reassembler: Reassembler,
        fleet: Fleet,
        graph: PoseGraph,
        answers: Answers,
        settings: ReconstructionSettings,
        rebuild: Rebuild | None,
    ) -> None:
        self.counters: Counter[str] = Counter()
        self._reassembler, self._fleet, self._graph = reassembler, fleet, graph
        self._answers, self._settings, self._rebuild = answers, settings, rebuild
        self._ranges_used_s: dict[int, float] = {}

    def receive(self, packet: Fragment | TrajectoryPacket, now_s: float) -> None:
        """Take a packet: states are used now, fragments wait for the next `sheets`."""
        if isinstance(packet, TrajectoryPacket):
            first_s = from_quarters(packet.header.time_quarters, now_s)
            self._receive_states(packet.header, first_s, packet.states, now_s)
        else:
            self._reassembler.receive(packet, now_s)

    def sheets(self, now_s: float) -> Iterator[Sheet | None]:
        """Yield the sheet of each sub-map that the reassembly hands on, None if it is empty."""
        self._reassembler.advance(now_s)
        while (event := self._reassembler.next_event()) is not None:
            if isinstance(event, FragmentArrived):
                self._receive_fragment(event.fragment, now_s)
            else:
                yield from self._rebuilt(event)

    def _rebuilt(self, transfer: SubmapTransfer) -> Iterator[Sheet | None]:
        """Yield the sheet of a sub-map rebuilt from the fragments that arrived, if it has one."""
        header = next(iter(transfer.fragments.values())).header
        boot = self._fleet.boot_of(header)
        sheet_id = SheetId(vehicle=header.vehicle, boot_epoch=boot, submap=header.submap)
        self._use_ranges(sheet_id.chain)
        try:
            rebuilt = (self._rebuild or self._reconstruct)(transfer)
        except EstimationError:
            self.counters["submaps_not_rebuilt"] += 1
            return
        if rebuilt.track.time_s.size == 0:
            self.counters["submaps_without_track"] += 1
        elif not self._is_on_track(sheet_id.chain, rebuilt.track):
            self.counters["submaps_off_track"] += 1
        else:
            yield sheet_of(sheet_id, rebuilt.track, rebuilt.grid)

    def _reconstruct(self, transfer: SubmapTransfer) -> Reconstruction:
        return reconstruct_packets(transfer.fragments, self._settings, transfer.first_arrival_s)

    def _is_on_track(self, chain: int, track: Track) -> bool:
        """Return whether a sub-map was measured where its chain was, so that it can be placed."""
        try:
            known = self._fleet.track(chain)
            for time_s in (track.time_s[0], track.time_s[-1]):
                self._graph.anchor(chain, float(time_s), known)
        except (EstimationError, KeyError):
            return False
        reckoned_m = np.column_stack([track.north_m, track.east_m])
        apart_m = np.hypot(*(known.position_at(track.time_s) - reckoned_m).T)
        return bool(apart_m.max() <= _OFF_TRACK_M)

    def _receive_fragment(self, fragment: Fragment, now_s: float) -> None:
        """Take the states that a fragment carries; they are of use before its sub-map is."""
        header = fragment.header
        first_s = from_quarters(header.time_quarters, now_s)
        if isinstance(fragment, SubmapPacket):
            self._receive_states(header, first_s, fragment.trajectory, now_s)
            return
        try:
            states = states_of_fragment(fragment)
        except EstimationError:
            self.counters["fragments_without_track"] += 1
            return
        self._receive_states(header, first_s, states, now_s)

    def _receive_states(
        self, header: Header, first_s: float, states: np.ndarray, now_s: float
    ) -> None:
        last = self._fleet.receive_states(header, first_s, states, now_s)
        if last is None:
            return
        chain, last_s = last
        self._answers.note(header, chain, last_s)
        if last_s >= self._ranges_used_s.get(chain, -np.inf) + _RANGE_WINDOW_S:
            self._ranges_used_s[chain] = last_s
            self._use_ranges(chain)

    def _use_ranges(self, chain: int) -> None:
        """Let a follower's chain grow by its known track, and use the ranges that this frees."""
        self._fleet.extend(chain)
        self._fleet.use_ranges(chain)
