"""One-way ranges: held until the sender's state at transmission is known, judged, then used."""

import enum
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from firmware.geometry import offset_covariance
from firmware.leader.ledger import Anchor
from firmware.leader.pose_graph import PoseGraph
from firmware.leader.range_judge import RangeJudge, RangeSettings, RangeVerdict
from firmware.sound_speed import horizontal_m
from firmware.submaps import Track
from protocol.errors import EstimationError
from protocol.packets import Header
from protocol.timestamps import transmission_s


@dataclass(frozen=True, slots=True, kw_only=True)
class _HeldRange:
    """A slant range whose sender's track arrives only later."""

    chain: int
    sent_s: float
    arrived_s: float
    range_m: float
    depth_difference_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _PlacedRange:
    """A slant range between two anchors of the graph, and the horizontal one that it predicts.

    clock_m of it are due to the sender's clock, as far as that is known.
    """

    sender: int
    range_m: float
    depth_difference_m: float
    clock_m: float
    clock_sigma_m: float
    here: Anchor
    there: Anchor
    predicted_m: float
    direction: np.ndarray  # (2,) unit vector from here to there


@dataclass(frozen=True, slots=True, kw_only=True)
class _BelievedRange:
    """A range for the graph: horizontal, except for what the sender's clock adds.

    Steepness is the difference in depth over the horizontal distance: the slant adds, in
    quadrature, the sigma of a range times its steepness.
    """

    placed: _PlacedRange
    range_m: float
    steepness: float
    stretched: bool


@dataclass(slots=True)
class _Window:
    """Ranges judged together, and the records entered for them while they bend too much."""

    held: list[_HeldRange]
    entered: list[int] = field(default_factory=list)  # numbers of the ledger
    bent_m: float = np.inf

    @property
    def is_judged(self) -> bool:
        """Whether it was once entered, or all of it rejected."""
        return self.bent_m < np.inf


class _Fate(enum.Enum):
    """What became of a window that was judged."""

    ENTERED = enum.auto()
    ROUGHLY = enum.auto()  # and it waits to be entered anew
    BENT = enum.auto()
    UNDECIDED = enum.auto()


class RangeWindows:
    """Ranges in by `hold`, factors out by `use`; bounded, everything dropped is counted."""

    def __init__(self, settings: RangeSettings) -> None:
        self.counters: Counter[str] = Counter()
        self._settings = settings
        self._judge = RangeJudge(settings)
        self._held: deque[_HeldRange] = deque(maxlen=settings.held)
        self._waiting: dict[int, deque[_Window]] = {}

    def hold(self, chain: int, header: Header, toa_s: float, depth_m: float) -> None:
        """Keep the range that a frame's arrival tells, until its sender's track is known.

        depth_m is our own. Frames of one packet arrive as one: their range is one measurement,
        not several.
        """
        s = self._settings
        if any(r.chain == chain and r.arrived_s == toa_s for r in self._held):
            self.counters["ranges_of_one_packet"] += 1
            return
        sent_s = transmission_s(header.tx_second, toa_s)
        sender_m = depth_m if s.follower_depth_m is None else s.follower_depth_m
        speed_mps = s.sound_profile.speed_mps(sender_m, depth_m, s.sound_speed_mps)
        range_m = (toa_s - sent_s) * speed_mps
        depth_difference_m = abs(sender_m - depth_m)
        if not s.shortest_m <= range_m <= s.longest_m:
            self.counters["ranges_impossible"] += 1
            return
        if not horizontal_m(range_m, depth_difference_m) > 0.0:
            self.counters["ranges_too_steep"] += 1
            return
        if len(self._held) == self._held.maxlen:
            self.counters["ranges_overwritten"] += 1
        self._held.append(
            _HeldRange(
                chain=chain,
                sent_s=sent_s,
                arrived_s=toa_s,
                range_m=range_m,
                depth_difference_m=depth_difference_m,
            )
        )

    def use(
        self, chain: int, track: Track, receiver: int, receiver_track: Track, graph: PoseGraph
    ) -> None:
        """Judge, by windows, the held ranges whose both ends are known; enter the good ones.

        While two explanations of a window compete it waits, and the next one joins it. While the
        vehicles may lie so far across the line of sight that a range bends, it is used roughly at
        most, and waits as well. Once a window is understood, those that wait are tried again,
        newest first.
        """
        end_s = float(track.time_s[-1])
        ready = [r for r in self._held if r.chain == chain and r.sent_s <= end_s]
        if not ready:
            return
        self._held = deque((r for r in self._held if r not in ready), self._held.maxlen)
        graph.update()
        waiting = self._waiting.setdefault(chain, deque())
        for held in ready:
            self._join(waiting, held)
        still: deque[_Window] = deque()
        while waiting:
            window = waiting.pop()
            placed = self._placed(window, (receiver, receiver_track), (chain, track), graph)
            fate = self._enter(window, placed, graph) if placed else _Fate.ENTERED
            if fate in (_Fate.ENTERED, _Fate.ROUGHLY):
                graph.update()
            if fate is not _Fate.ENTERED:
                still.appendleft(window)
            if fate is _Fate.BENT:
                break
        waiting.extend(still)

    def _join(self, waiting: deque[_Window], held: _HeldRange) -> None:
        """Let a range wait with the newest window, or begin a new one; bounded."""
        s = self._settings
        newest = waiting[-1] if waiting else None
        if (
            newest is not None
            and not newest.is_judged
            and abs(held.sent_s - newest.held[0].sent_s) <= s.joined_s
            and len(newest.held) < s.joined
        ):
            newest.held.append(held)
            return
        waiting.append(_Window([held]))
        if len(waiting) > s.waiting:
            oldest = waiting.popleft()
            fate = "ranges_left_rough" if oldest.entered else "ranges_given_up"
            self.counters[fate] += len(oldest.held)

    def _placed(
        self,
        window: _Window,
        receiver: tuple[int, Track],
        sender: tuple[int, Track],
        graph: PoseGraph,
    ) -> list[_PlacedRange]:
        """Return the ranges of a window between their anchors; those that have none leave it."""
        placed = []
        for held in tuple(window.held):
            try:
                here = graph.anchor(receiver[0], held.arrived_s, receiver[1])
                there = graph.anchor(sender[0], held.sent_s, sender[1])
                placed.append(_between(held, here, there, sender[0], graph))
            except EstimationError:
                self.counters["ranges_unplaceable"] += 1
                window.held.remove(held)
        return placed

    def _enter(self, window: _Window, placed: list[_PlacedRange], graph: PoseGraph) -> _Fate:
        """Enter what can be believed of a window, unless it has to wait.

        A window whose bend its noise does not hide is entered with a sigma that grows with the
        bend, and anew once it bends half as much; the new verdict rests on the first to a small
        part. Records that were composed with others meanwhile stay as they are.
        """
        if not all(number in graph for number in window.entered):
            self.counters["ranges_left_rough"] += len(placed)
            return _Fate.ENTERED
        s, middle = self._settings, placed[len(placed) // 2]
        try:
            along_m, bent_m = _spread(middle, graph)
        except EstimationError:
            return _Fate.UNDECIDED
        roughly = bent_m > s.bent_m
        if roughly and bent_m > min(0.5 * window.bent_m, s.bent_share * middle.predicted_m):
            return _Fate.BENT
        verdict = self._judge.judge(
            np.array([p.range_m - p.clock_m for p in placed]),
            np.array([np.hypot(p.predicted_m, p.depth_difference_m) for p in placed]),
            np.array([p.there.time_s for p in placed]),
            float(np.hypot(along_m, bent_m)),
        )
        if not verdict.certain:
            return _Fate.UNDECIDED
        for number in window.entered:
            graph.set_active(number, active=False)
        believed = list(self._believed(placed, verdict))
        if not window.is_judged:
            self._judge.learn(verdict)
            self.counters["ranges_used_roughly"] += len(believed) if roughly else 0
        spread_m = bent_m * float(s.bent_alike * np.sqrt(len(placed))) if roughly else bent_m
        window.bent_m = bent_m
        window.entered = [
            graph.add_range(
                b.placed.here,
                b.placed.there,
                b.range_m,
                float(np.hypot(spread_m, s.sigma_m * b.steepness)),
                sender=b.placed.sender,
            )
            for b in believed
        ]
        if roughly:
            return _Fate.ROUGHLY
        unstretched = sum(b.stretched for b in believed)
        self.counters["ranges_used"] += len(believed) - unstretched
        self.counters["ranges_unstretched"] += unstretched
        self.counters["ranges_rejected"] += len(placed) - len(window.entered)
        return _Fate.ENTERED

    def _believed(
        self, placed: list[_PlacedRange], verdict: RangeVerdict
    ) -> Iterator[_BelievedRange]:
        """Yield the ranges that are believed, without their stretch and slant.

        One that is found to be shorter than its ends are apart in depth is left out.
        """
        for p, true, stretched in zip(placed, verdict.true, verdict.stretched, strict=True):
            if not true and not stretched:
                continue
            range_m = p.range_m
            if stretched:
                range_m = p.clock_m + (p.range_m - p.clock_m) / self._settings.outlier_factor
            slant_m = range_m - p.clock_m
            across_m = horizontal_m(slant_m, p.depth_difference_m)
            if across_m > 0.0:
                yield _BelievedRange(
                    placed=p,
                    range_m=range_m - (slant_m - across_m),
                    steepness=p.depth_difference_m / across_m,
                    stretched=bool(stretched),
                )


def _spread(placed: _PlacedRange, graph: PoseGraph) -> tuple[float, float]:
    """Return the sigma of the predicted range, and that of what its linearisation leaves out.

    A range is longer by u^2 / 2r when the vehicles lie u farther across the line of sight. Where
    that is as large as the range's noise, a linear filter chooses one side of the line and grows
    sure of it, though the mirror image fits as well.
    """
    covariance_m2 = offset_covariance(graph.covariance([placed.here, placed.there]))
    along, across = placed.direction, np.array([-placed.direction[1], placed.direction[0]])
    along_m2 = float(along @ covariance_m2 @ along) + placed.clock_sigma_m**2
    bent_m = float(across @ covariance_m2 @ across) / (np.sqrt(2.0) * placed.predicted_m + 1e-3)
    return float(np.sqrt(max(along_m2, 1e-6))), bent_m


def _between(
    held: _HeldRange, here: Anchor, there: Anchor, sender: int, graph: PoseGraph
) -> _PlacedRange:
    """Return a held range between the anchors of its ends, ours first."""
    clock_m, clock_sigma_m = graph.clock(sender, held.sent_s)
    between_m = graph.position(there) - graph.position(here)
    predicted_m = float(np.hypot(*between_m))
    return _PlacedRange(
        sender=sender,
        range_m=held.range_m,
        depth_difference_m=held.depth_difference_m,
        clock_m=clock_m,
        clock_sigma_m=clock_sigma_m,
        here=here,
        there=there,
        predicted_m=predicted_m,
        direction=between_m / max(predicted_m, 1e-3),
    )
