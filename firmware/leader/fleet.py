"""The followers as the leader knows them: one chain of the graph for each boot of each vehicle.

A vehicle that restarts counts its sub-maps from zero and may begin dead reckoning anew; one that
lost its navigation for a while announces a new boot, too. What was known of it stays where it is;
the new boot is a chain of its own, tied to the old one by how far the vehicle can have come
meanwhile. A boot is the header's epoch, unwrapped; a lasting jump of dead reckoning without a
restart counts as another boot of the same epoch.
"""

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from firmware.leader.atlas import chain_of, vehicle_of
from firmware.leader.pose_graph import PoseGraph
from firmware.leader.range_windows import RangeWindows
from firmware.leader.tracks import TrackBuffer
from firmware.leader.trajectory import Trajectory
from firmware.submaps import Track, concatenated
from protocol.packets import Header, usable_states
from protocol.settings import Settings, setting
from protocol.timestamps import from_quarters
from protocol.vehicles import BOOT_EPOCHS, LEADER

_HELD_M = 1.0  # dead reckoning that stands still was held while navigation was lost
_CONTINUES_M = 3.0  # dead reckoning that goes on lies this near to a straight continuation
_MOST_BOOTS = 20  # of a vehicle within an hour: two senders of one number begin one by every frame
_HOUR_S = 3600.0

Timed = TypeVar("Timed", Track, Trajectory)


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetSettings(Settings):
    """What is believed of another vehicle's trajectory."""

    fastest_mps: float = setting(
        6.0, "m/s", "survey vehicles make half of it; a faster one has jumped", minimum=0.5
    )
    oldest_state_s: float = setting(
        900.0, "s", "no follower keeps a frame for as long; older is damage", minimum=60.0
    )
    jumped_states: int = setting(
        30, "states", "that agree with each other and not with the track: a new start", minimum=2
    )


@dataclass(slots=True)
class _Vehicle:
    """What is known of one follower's present boot, and when its newest ones began."""

    boot: int
    jumped: deque[tuple[float, float, float]] = field(default_factory=deque)
    begun_s: deque[float] = field(default_factory=lambda: deque(maxlen=_MOST_BOOTS))


class Fleet:
    """Tracks and chains of all vehicles; the leader's own track is among them."""

    def __init__(self, graph: PoseGraph, ranging: RangeWindows, settings: FleetSettings) -> None:
        self.counters: Counter[str] = Counter()
        self._graph, self._ranging, self._settings = graph, ranging, settings
        self._tracks: dict[int, TrackBuffer] = {LEADER: TrackBuffer()}
        self._followers: dict[int, _Vehicle] = {}

    @property
    def own(self) -> TrackBuffer:
        """The leader's own track."""
        return self._tracks[LEADER]

    @property
    def overflowed(self) -> int:
        """How many states found no room in the track of their chain."""
        return sum(buffer.overflowed for buffer in self._tracks.values())

    def vehicles(self) -> list[int]:
        """Return the vehicles that have a chain, the leader first."""
        return sorted({vehicle_of(chain) for chain in self._graph.chains()})

    def admit(self, header: Header, now_s: float) -> bool:
        """Begin the boot that a frame tells of, if it is new; return whether the frame may be used.

        It may not where its vehicle has begun too many boots within the hour.
        """
        known = self._followers.setdefault(header.vehicle, _Vehicle(boot=header.boot_epoch))
        boot = self.boot_of(header)
        if boot <= known.boot:
            return True
        if not self._note_boot(known, now_s):
            return False
        known.boot = boot
        known.jumped.clear()
        self.counters["restarts"] += 1
        return True

    def boot_of(self, header: Header) -> int:
        """Return the boot that a frame of a known vehicle tells of.

        A late frame's may be earlier than the newest.
        """
        newest = self._followers[header.vehicle].boot
        ahead = (header.boot_epoch - newest) % BOOT_EPOCHS
        if ahead == 0:
            return newest
        turns = range(newest + ahead - BOOT_EPOCHS, -1, -BOOT_EPOCHS)
        likely = turns[:1] if ahead >= BOOT_EPOCHS // 2 else ()
        heard = [boot for boot in turns if chain_of(header.vehicle, boot) in self._tracks]
        late = (boot for boot in (*heard, *likely) if self._is_late(header, boot))
        return next(late, newest + ahead)

    def chain(self, header: Header) -> int:
        """Return the number of the chain that a frame's states belong to."""
        return chain_of(header.vehicle, self.boot_of(header))

    def receive_states(
        self, header: Header, first_s: float, states: NDArray[np.floating], now_s: float
    ) -> tuple[int, float] | None:
        """Keep the states (T, 3), one a second from first_s.

        Return the chain and the time of the last one that was kept, or None.
        """
        s, last = self._settings, None
        for k in np.flatnonzero(usable_states(states)):
            time_s = first_s + float(k)
            if time_s > now_s:
                self.counters["states_from_the_future"] += 1
            elif time_s < now_s - s.oldest_state_s:
                self.counters["states_too_old"] += 1
            elif (chain := self._place(header, time_s, states[k], now_s)) is not None:
                last = chain, time_s
            else:
                self.counters["states_that_jump"] += 1
        return last

    def extend(self, chain: int) -> None:
        """Let a chain grow by its known track."""
        buffer = self._tracks.get(chain)
        if buffer is None or not len(buffer):
            return
        track = buffer.track()
        self._graph.extend(LEADER, self.own.track())
        if chain not in self._graph.chains():
            self._begin(chain, track)
        self._graph.extend(chain, track)
        self._graph.update()

    def use_ranges(self, chain: int) -> None:
        """Use the held ranges whose senders' states are known by now."""
        if chain in self._graph.chains() and len(self.own):
            self._ranging.use(chain, self.track(chain), LEADER, self.own.track(), self._graph)

    def settle(self, before_s: float) -> None:
        """Let the tracks forget what only late frames could ask for."""
        for buffer in self._tracks.values():
            buffer.settle(before_s)

    def track(self, chain: int) -> Track:
        """Return the raw dead-reckoned track of a chain."""
        return self._tracks[chain].track()

    def whole_track(self, vehicle: int) -> Track:
        """Return the tracks of all of a vehicle's boots, each up to where the next begins."""
        return concatenated(_in_turn([self.track(chain) for chain in self._chains(vehicle)]))

    def whole_trajectory(self, vehicle: int) -> Trajectory:
        """Return the estimate over all of a vehicle's boots, each up to where the next begins."""
        chains = self._chains(vehicle)
        return concatenated(_in_turn([self._graph.trajectory(chain) for chain in chains]))

    def chain_at(self, vehicle: int, time_s: float) -> int:
        """Return the chain of a vehicle that the time belongs to."""
        chains = self._chains(vehicle)
        begun = [c for c in chains if self.track(c).time_s[0] <= time_s]
        return begun[-1] if begun else chains[0]

    def reaches(self, vehicle: int, time_s: float) -> bool:
        """Return whether dead reckoning of a vehicle is known up to a time."""
        chains = self._chains(vehicle)
        return bool(chains) and float(self.track(chains[-1]).time_s[-1]) >= time_s

    def newest_chain(self, vehicle: int) -> int:
        """Return the chain of a vehicle's newest boot."""
        return self._chains(vehicle)[-1]

    def _chains(self, vehicle: int) -> list[int]:
        chains = [c for c in self._graph.chains() if vehicle_of(c) == vehicle]
        return sorted(chains, key=lambda chain: float(self.track(chain).time_s[0]))

    def _place(
        self, header: Header, time_s: float, state: NDArray[np.floating], now_s: float
    ) -> int | None:
        """Keep a state that its track's neighbours allow, and return its chain, or None.

        A lasting jump begins a new boot.
        """
        north_m, east_m, yaw_rad = (float(value) for value in state)
        chain = self.chain(header)
        buffer = self._tracks.setdefault(chain, TrackBuffer())
        if buffer.is_plausible(time_s, north_m, east_m, self._settings.fastest_mps):
            buffer.add(time_s, north_m, east_m, yaw_rad)
            return chain
        known = self._followers[header.vehicle]
        jumped = known.jumped
        if any(time_s == known_s for known_s, _, _ in jumped):
            return None  # told again, as every frame of a sub-map may tell its whole track
        if jumped and not 0.0 <= time_s - jumped[-1][0] <= 60.0:
            jumped.clear()
        reach_m = self._settings.fastest_mps * (time_s - jumped[-1][0]) + 1.0 if jumped else np.inf
        if jumped and np.hypot(north_m - jumped[-1][1], east_m - jumped[-1][2]) > reach_m:
            jumped.clear()
        jumped.append((time_s, north_m, east_m))
        if len(jumped) >= self._settings.jumped_states:
            jumped.clear()
            if self._note_boot(known, now_s):
                known.boot += BOOT_EPOCHS
                self.counters["lasting_jumps"] += 1
        return None

    def _note_boot(self, known: _Vehicle, now_s: float) -> bool:
        """Note that a vehicle begins another boot; return False where it may not."""
        begun_s = known.begun_s
        if len(begun_s) == _MOST_BOOTS and abs(now_s - begun_s[0]) < _HOUR_S:
            self.counters["boots_refused"] += 1
            return False
        begun_s.append(now_s)
        return True

    def _is_late(self, header: Header, earlier: int) -> bool:
        """Return whether a frame is of an earlier boot: by its time where a later one has begun."""
        chain = chain_of(header.vehicle, earlier)
        later = [c for c in self._tracks if vehicle_of(c) == header.vehicle and c > chain]
        if not later:
            return chain in self._tracks
        begun_s = float(self.track(min(later)).time_s[0])
        return from_quarters(header.time_quarters, begun_s) < begun_s

    def _begin(self, chain: int, track: Track) -> None:
        """Start a chain: a vehicle's first at its deployment, a later one where the last ended."""
        time_s = float(track.time_s[0])
        start_m = track.position_at(time_s)
        chains = self._chains(vehicle_of(chain))
        earlier = [c for c in chains if self.track(c).time_s[0] < time_s]
        if not earlier:
            self._graph.add_chain(chain, time_s, start_m, start_m)
            return
        before, old = earlier[-1], self.track(earlier[-1])
        self._graph.extend(before, old)
        last_s = float(old.time_s[-1])
        gap_s = max(time_s - last_s, 0.0)
        last_m = old.position_at(last_s)
        velocity_mps = (last_m - old.position_at(last_s - 5.0)) / 5.0
        on_m = start_m - last_m
        reached_m, sigma_m = last_m, self._settings.fastest_mps / 2 * gap_s + 5.0
        goes_on = np.hypot(*(on_m - velocity_mps * gap_s)) < _CONTINUES_M + 0.2 * np.sqrt(gap_s)
        if time_s < last_s:  # by a clock set back: nobody knows how long ago the old one ended
            reached_m, sigma_m = start_m, 5.0 + float(np.hypot(*on_m))
        elif goes_on and np.hypot(*on_m) > _HELD_M:
            reached_m, sigma_m = start_m, 1.0 + 0.02 * gap_s
        self._graph.add_boot(
            chain, time_s, start_m, after=before, reached_m=reached_m, sigma_m=sigma_m
        )


def _in_turn(parts: Sequence[Timed]) -> list[Timed]:
    """Return values of ascending times, each up to where the next begins: clocks are set back."""
    ends_s = [*(part.time_s[0] for part in parts[1:]), np.inf]
    rows = [slice(int(np.searchsorted(p.time_s, e))) for p, e in zip(parts, ends_s, strict=True)]
    return [
        replace(part, **{f.name: getattr(part, f.name)[r] for f in fields(part)})
        for part, r in zip(parts, rows, strict=True)
    ]
