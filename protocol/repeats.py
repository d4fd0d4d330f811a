"""What a follower transmits next: fresh fragments, and lost ones again where the air is free.

The leader's extended answers name missing fragments. A repeat never takes a slot that the fresh
fragments of the running sub-map need, no fragment is repeated more than a few times, and a request
that was made before the last copy could arrive is ignored: so requests cannot make a storm.
"""

from collections import Counter, OrderedDict, deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from protocol.packets import MAX_FRAGMENTS, Fragment
from protocol.reassembly import SUBMAPS_MODULO
from protocol.settings import Settings, setting
from protocol.timestamps import to_tx_second


@dataclass(frozen=True, slots=True, kw_only=True)
class RepeatSettings(Settings):
    """How long fragments are kept, and how often they are sent."""

    submaps_kept: int = setting(
        6, "sub-maps", "older ones the leader has closed by its own deadline", minimum=1
    )
    most_repeats: int = setting(
        4, "times", "at 14 % loss one fragment in 20,000 needs a fifth", minimum=0, maximum=15
    )
    settle_s: float = setting(
        4.0, "s", "airtime and travel time before an answer can know of a copy", minimum=0.0
    )


@dataclass(slots=True)
class _Kept:
    """A sub-map's fragments that may be asked for again."""

    fragments: dict[int, Fragment]
    sent_s: dict[int, float] = field(default_factory=dict)
    repeats: Counter[int] = field(default_factory=Counter)


class FragmentQueue:
    """Fragments of finished sub-maps in, one packet per slot out.

    `counters`: fresh, repeated, and what was ignored: early (a copy was still on its way),
    exhausted (repeated often enough), unknown (no longer kept), overtaken (of no more use), dropped
    (fresh ones beyond the cap).
    """

    def __init__(self, settings: RepeatSettings) -> None:
        self.counters: Counter[str] = Counter()
        self._settings = settings
        self._fresh: deque[Fragment] = deque()
        self._wanted: OrderedDict[tuple[int, int], None] = OrderedDict()  # (sub-map, fragment)
        self._kept: OrderedDict[int, _Kept] = OrderedDict()

    @property
    def fresh(self) -> int:
        """How many fragments wait for their first transmission."""
        return len(self._fresh)

    @property
    def wanted(self) -> int:
        """How many fragments wait to be sent again."""
        return len(self._wanted)

    def add(self, fragments: Sequence[Fragment]) -> None:
        """Queue a finished sub-map; the oldest one kept is forgotten when there are too many."""
        for fragment in fragments:
            if len(self._fresh) == 2 * MAX_FRAGMENTS:
                self._fresh.popleft()
                self.counters["dropped"] += 1
            self._fresh.append(fragment)
        submap = fragments[0].header.submap
        self._kept[submap] = _Kept({f.header.fragment: f for f in fragments})
        while len(self._kept) > self._settings.submaps_kept:
            self._forget(next(iter(self._kept)))

    def request(self, submap: int, bitmap: int, asked_s: float) -> None:
        """Take the leader's wish; asked_s is when its answer was heard.

        It asks for the oldest sub-map that it still holds open: what was wanted of older ones, or
        of this one and is not any more, would arrive in vain and make the next repeat late too.
        """
        self._drop_overtaken(submap, bitmap)
        kept = self._kept.get(submap)
        for fragment in (i for i in range(MAX_FRAGMENTS) if bitmap >> i & 1):
            if kept is None or fragment not in kept.fragments:
                self.counters["unknown"] += 1
            elif asked_s < kept.sent_s.get(fragment, asked_s + 1.0) + self._settings.settle_s:
                self.counters["early"] += 1
            elif kept.repeats[fragment] >= self._settings.most_repeats:
                self.counters["exhausted"] += 1
            else:
                self._wanted[submap, fragment] = None

    def next_fragment(self, now_s: float, slots_left: int) -> Fragment | None:
        """Return what to transmit now, its transmission second set, or None.

        slots_left counts this slot and those before the next sub-map is due: a repeat goes first
        when the fresh fragments fit without this slot, and never otherwise.
        """
        fragment = None
        if self._wanted and len(self._fresh) < slots_left:
            (submap, index), _ = self._wanted.popitem(last=False)
            kept = self._kept[submap]
            kept.repeats[index] += 1
            self.counters["repeated"] += 1
            fragment = kept.fragments[index]
        elif self._fresh:
            self.counters["fresh"] += 1
            fragment = self._fresh.popleft()
        if fragment is None:
            return None
        if fragment.header.submap in self._kept:
            self._kept[fragment.header.submap].sent_s[fragment.header.fragment] = now_s
        return replace(fragment, header=replace(fragment.header, tx_second=to_tx_second(now_s)))

    def _drop_overtaken(self, submap: int, bitmap: int) -> None:
        if not bitmap:
            return
        for wanted in list(self._wanted):
            behind = (submap - wanted[0]) % SUBMAPS_MODULO
            arrived = behind == 0 and not bitmap >> wanted[1] & 1
            if arrived or 0 < behind < SUBMAPS_MODULO // 2:
                del self._wanted[wanted]
                self.counters["overtaken"] += 1

    def _forget(self, submap: int) -> None:
        del self._kept[submap]
        for key in [key for key in self._wanted if key[0] == submap]:
            del self._wanted[key]
