"""Sub-maps complete with and without selective repeat, and the air that it takes.

`python -m benchmarks.link` prints the table: one leader and one to four followers over the model of
the water, extended answers, `dense` frames, reassembly as the leader sets it for these slots; plain
broadcast is the paper's link.
"""

import argparse
import sys
from dataclasses import dataclass, replace

import numpy as np

from firmware.leader.settings import LeaderSettings, reassembly_of
from protocol.acoustics import Water, WaterSettings
from protocol.codec import decode, encode
from protocol.packets import SIZE_BYTES, ExtendedAnswer, Header, Profile, SubmapFragment
from protocol.reassembly import Reassembler, SubmapTransfer
from protocol.repeats import FragmentQueue, RepeatSettings
from protocol.schedule import Slots, SlotSettings
from protocol.timestamps import to_quarters, to_tx_second, transmission_s
from protocol.vehicles import LEADER

LEADER_SETTINGS = LeaderSettings(answers="extended")
SUBMAP_S = int(LEADER_SETTINGS.submaps.duration_s)
CASES = (
    # followers, frames
    (1, 10),
    (1, 8),
    (1, 6),
    (2, 4),
    (4, 2),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """What one trial came to; times in seconds, shares of the plain broadcast's air."""

    submaps: int
    complete: int
    fresh: int
    repeated: int
    answer_bytes: int
    mean_delay_s: float

    @property
    def complete_share(self) -> float:
        """Of all sub-maps that were made."""
        return self.complete / self.submaps

    @property
    def extra_air(self) -> float:
        """Repeats by fresh fragments."""
        return self.repeated / self.fresh


@dataclass(slots=True)
class _Follower:
    queue: FragmentQueue
    submap: int = 0


def trial(
    *,
    followers: int = 1,
    frames: int = 8,
    loss: float = 0.14,
    repeats: bool = True,
    hours: float = 2.0,
    seed: int = 1,
    water: WaterSettings | None = None,
) -> Result:
    """Return the result of some hours of sub-maps over one water."""
    settings = replace(water or WaterSettings(), loss=loss)
    medium = Water(settings, np.random.default_rng(seed), _place, range(followers + 1))
    slots = Slots(SlotSettings(followers=followers))
    reassembler = Reassembler(reassembly_of(LEADER_SETTINGS, slots))
    fleet = {k: _Follower(FragmentQueue(RepeatSettings())) for k in range(1, followers + 1)}
    transfers: list[SubmapTransfer] = []
    answers = 0
    turn = 0
    for second in range(int(3600 * hours) + 6 * SUBMAP_S):
        now_s = float(second)
        _deliver(medium, now_s, reassembler, fleet if repeats else {})
        reassembler.advance(now_s)
        while (event := reassembler.next_event()) is not None:
            if isinstance(event, SubmapTransfer):
                transfers.append(event)
        running = now_s < 3600 * hours
        for number, follower in fleet.items():
            if running and second % SUBMAP_S == 0:
                follower.queue.add(_fragments(number, follower.submap, frames, now_s))
                follower.submap += 1
            if slots.next_follower_slot_s(now_s, number) == now_s:
                left = _slots_left(second, followers) if running else 1000
                fragment = follower.queue.next_fragment(now_s, left)
                if fragment is not None:
                    medium.transmit(number, now_s, encode(fragment))
        if slots.next_leader_slot_s(now_s) == now_s:
            turn = _next_turn(reassembler, turn, followers)
            medium.transmit(LEADER, now_s, encode(_answer(reassembler, turn, answers, now_s)))
            answers += 1
    done = [transfer for transfer in transfers if transfer.is_complete]
    delays = [t.last_arrival_s - t.submap * SUBMAP_S for t in done]
    counters = [follower.queue.counters for follower in fleet.values()]
    return Result(
        submaps=sum(follower.submap for follower in fleet.values()),
        complete=len(done),
        fresh=sum(counter["fresh"] for counter in counters),
        repeated=sum(counter["repeated"] for counter in counters),
        answer_bytes=answers * SIZE_BYTES[Profile.ANSWER_EXTENDED],
        mean_delay_s=float(np.mean(delays)) if delays else float("nan"),
    )


def _place(node: int, _: float) -> tuple[float, float, float]:
    return 150.0 * node, 100.0 * node, 10.0


def _slots_left(second: int, followers: int) -> int:
    period_s = 4 * followers
    return 1 + (SUBMAP_S - 1 - second % SUBMAP_S) // period_s


def _fragments(vehicle: int, submap: int, count: int, now_s: float) -> list[SubmapFragment]:
    header = Header(
        profile=Profile.SUBMAP_DENSE,
        vehicle=vehicle,
        boot_epoch=0,
        submap=submap % 65536,
        fragment=0,
        fragment_count=count,
        tx_second=0,
        time_quarters=to_quarters(now_s),
    )
    return [
        SubmapFragment(header=replace(header, fragment=i), body=bytes(244)) for i in range(count)
    ]


def _next_turn(reassembler: Reassembler, turn: int, followers: int) -> int:
    """Return whom to answer: the next that lacks something, or else the next."""
    order = [(turn + i) % followers + 1 for i in range(followers)]
    return next((number for number in order if reassembler.missing(number, 0)), order[0])


def _answer(reassembler: Reassembler, vehicle: int, number: int, now_s: float) -> ExtendedAnswer:
    submap, missing = reassembler.missing(vehicle, 0) or (0, 0)
    return ExtendedAnswer(
        header=Header(
            profile=Profile.ANSWER_EXTENDED,
            vehicle=LEADER,
            boot_epoch=0,
            submap=number % 65536,
            fragment=vehicle,
            fragment_count=0,
            tx_second=to_tx_second(now_s),
            time_quarters=0,
        ),
        submap=0,
        north_m=0.0,
        east_m=0.0,
        variance_m2=1.0,
        leader_north_m=0.0,
        leader_east_m=0.0,
        leader_variance_m2=1.0,
        repeat_submap=submap,
        missing_fragments=missing,
    )


def _deliver(
    medium: Water, now_s: float, reassembler: Reassembler, fleet: dict[int, _Follower]
) -> None:
    for delivery in medium.deliveries_until(now_s):
        if delivery.t_rx_s is None:
            continue
        packet = decode(delivery.frame)
        if delivery.destination == LEADER and isinstance(packet, SubmapFragment):
            reassembler.receive(packet, delivery.t_delivered_s)
        elif isinstance(packet, ExtendedAnswer) and packet.to_vehicle == delivery.destination:
            follower = fleet.get(delivery.destination)
            if follower is not None and packet.missing_fragments:
                asked_s = transmission_s(packet.header.tx_second, delivery.t_rx_s)
                follower.queue.request(packet.repeat_submap, packet.missing_fragments, asked_s)


def main(arguments: list[str]) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.link", description=__doc__)
    parser.add_argument("--hours", type=float, default=20.0)
    parser.add_argument("--loss", type=float, default=0.14)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    print(f"loss {options.loss:.0%}, {options.hours:g} h, seed {options.seed}")
    print("followers  frames  link       complete  extra air  mean delay s")
    for followers, frames in CASES:
        for repeats in (False, True):
            result = trial(
                followers=followers,
                frames=frames,
                repeats=repeats,
                loss=options.loss,
                hours=options.hours,
                seed=options.seed,
            )
            name = "repeats" if repeats else "broadcast"
            print(
                f"{followers:9d}  {frames:6d}  {name:9s}"
                f"  {result.complete_share:8.2%}  {result.extra_air:9.2%}"
                f"  {result.mean_delay_s:12.1f}"
            )


if __name__ == "__main__":
    main(sys.argv[1:])
