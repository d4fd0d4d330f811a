"""The water: airtime, travel time, half-duplex, collisions, loss, damage, echoes, noisy ranges.

A broadcast medium in simulated time, a function of its seed and of what is transmitted when. Each
purpose and each directed link draws from a generator of its own, so that switching one effect on,
or adding a vehicle, leaves every other draw as it was.
"""

import heapq
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from protocol.errors import ConfigError, LocalProtocolError
from protocol.settings import Settings, setting

Position = tuple[float, float, float]
"""North, east, depth in metres, true."""
PURPOSES = ("loss", "spell", "corruption", "damage", "duplication", "noise", "outlier")
PACKED_BYTES = 128
"""Smaller frames go alone: answers are flexible packets."""
KEEP_S = 120.0
"""How long past sounds are remembered for collisions; longer than any frame and travel time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WaterSettings(Settings):
    """How the sea treats frames; the defaults are the paper's section 6."""

    rate_bps: float = setting(1000.0, "bit/s", "section 1 of the paper", minimum=1.0)
    sound_speed_mps: float = setting(1500.0, "m/s", "section 1 of the paper", minimum=1300.0)
    loss: float = setting(0.14, "share", "section 6.2 of the paper", minimum=0.0, maximum=1.0)
    loss_model: str = setting(
        "independent",
        "",
        "the paper names a share only; gilbert-elliott makes it come in bursts",
        choices=("independent", "gilbert-elliott"),
    )
    burst_frames: float = setting(
        4.0, "frames", "mean length of a bad spell of Gilbert-Elliott", minimum=1.0
    )
    bad_state_loss: float = setting(
        1.0, "share", "loss during a bad spell of Gilbert-Elliott", minimum=0.01, maximum=1.0
    )
    silent_from_min: float = setting(
        0.0, "min", "when the water falls silent: everything sent is lost", minimum=0.0
    )
    silent_min: float = setting(0.0, "min", "for how long; 0: never", minimum=0.0)
    packet_frames: int = setting(
        1,
        "frames",
        "of one packet, heard or lost together: two at a Micro-Modem's rates 3 and 4",
        minimum=1,
        maximum=8,
    )
    corruption: float = setting(
        0.0, "share", "modems check their frames; raw lines do not", minimum=0.0, maximum=1.0
    )
    corrupt_bits: float = setting(
        8.0, "bits", "mean number of bits turned in a corrupted frame", minimum=1.0
    )
    duplication: float = setting(
        0.0, "share", "frames heard twice by a surface echo", minimum=0.0, maximum=1.0
    )
    echo_delay_s: float = setting(0.2, "s", "of the second copy: 300 m more of path", minimum=0.0)
    range_noise_m: float = setting(1.0, "m", "Eq. 13: N(0, 1)", minimum=0.0)
    outlier_share: float = setting(
        0.2,
        "share",
        "Eq. 14: epsilon = 0.2, read as the outliers' share; 0.8 is the letter's reading",
        minimum=0.0,
        maximum=1.0,
    )
    outlier_factor: float = setting(1.1, "", "Eq. 14: delta_r", minimum=0.1)
    clock_offset_ms: float = setting(
        0.0, "ms", "a sender's clock behind node 0's: its frames seem to travel longer",
        minimum=-1000.0, maximum=1000.0,
    )  # fmt: skip
    clock_drift_ppm: float = setting(
        0.0, "ppm", "by which that grows", minimum=-1000.0, maximum=1000.0
    )
    reach_m: float = setting(
        20_000.0,
        "m",
        "beyond it nothing is heard; the clock's second is unambiguous to 23 km",
        minimum=1.0,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Delivery:
    """What became of one frame at one receiver.

    t_rx_s is the measured arrival of the first bit, noise and outlier included, None when nothing
    was received; the frame is complete, and handed over, at `t_delivered_s`. fate is delivered,
    corrupt, duplicate, lost, collision, half-duplex or out-of-reach. sent is the frame as it was
    transmitted, None where no node did that.
    """

    source: int
    destination: int
    t_tx_s: float
    t_rx_s: float | None
    t_delivered_s: float
    frame: bytes
    fate: str
    sent: bytes | None = None

    @property
    def was_received(self) -> bool:
        """Whether the receiver's modem has something to hand over."""
        return self.t_rx_s is not None


@dataclass(frozen=True, slots=True)
class _Arrival:
    """A frame that sounds at its receiver, what becomes of it if nothing else does, and an echo."""

    delivery: Delivery
    begins_s: float
    ends_s: float
    echo: bool


@dataclass(frozen=True, slots=True)
class _Interval:
    """When a node's own transducer is busy, or a frame sounds at it."""

    source: int
    begins_s: float
    ends_s: float


class Water:
    """The medium between nodes; event driven, deterministic."""

    def __init__(
        self,
        settings: WaterSettings,
        rng: np.random.Generator,
        position_of: Callable[[int, float], Position],
        nodes: Sequence[int] = (0, 1),
    ) -> None:
        self.settings = settings
        self.nodes = tuple(nodes)
        self._position_of = position_of
        self._seed = int(rng.integers(1 << 62))
        self._generators: dict[tuple[str, int, int], np.random.Generator] = {}
        self._is_bad: dict[tuple[int, int], bool] = {}
        self._packets: dict[tuple[int, int], tuple[int, bool]] = {}
        self._own: dict[int, list[_Interval]] = {node: [] for node in self.nodes}
        self._heard: dict[int, list[_Interval]] = {node: [] for node in self.nodes}
        self._queue: list[tuple[float, int, _Arrival]] = []
        self._sequence = 0
        self._to_bad, self._to_good = _spell_probabilities(settings)

    def airtime_s(self, size_bytes: int) -> float:
        """Return how long a frame of that size sounds."""
        return 8.0 * size_bytes / self.settings.rate_bps

    def transmitting_until_s(self, node: int) -> float:
        """Return when the node's last transmission ends, -inf when there was none."""
        return self._own[node][-1].ends_s if self._own[node] else -np.inf

    def transmit(
        self, node: int, now_s: float, frame: bytes, airtime_s: float | None = None
    ) -> None:
        """Start a transmission; a modem with its own modulation gives its own airtime.

        Raises
        ------
        LocalProtocolError
            When the node is unknown or still transmitting: its modem has to queue.
        """
        if node not in self._own:
            raise LocalProtocolError(f"node {node} is not in the water; nodes are {self.nodes}")
        if now_s < self.transmitting_until_s(node):
            until_s = self.transmitting_until_s(node)
            raise LocalProtocolError(f"node {node} at {now_s} s still transmits until {until_s} s")
        duration_s = self.airtime_s(len(frame)) if airtime_s is None else airtime_s
        self._forget(now_s - KEEP_S)
        self._own[node].append(_Interval(node, now_s, now_s + duration_s))
        for destination in self.nodes:
            if destination != node:
                self._launch(node, destination, now_s, duration_s, frame)

    def next_delivery_s(self) -> float | None:
        """Return when the next fate is decided, None when nothing is on its way."""
        return self._queue[0][0] if self._queue else None

    def deliveries_until(self, time_s: float) -> list[Delivery]:
        """Return the fates decided up to and including a time, oldest first, lost ones too."""
        deliveries = []
        while self._queue and self._queue[0][0] <= time_s:
            deliveries.append(self._decide(heapq.heappop(self._queue)[2]))
        return deliveries

    def travel_time_s(self, source: int, destination: int, t_tx_s: float) -> float:
        """Return the true travel time of sound that leaves at t_tx_s, both vehicles moving."""
        origin = np.asarray(self._position_of(source, t_tx_s))
        travel_s = 0.0
        for _ in range(3):  # contracts by speed / sound speed, 1e-3, each time
            target = np.asarray(self._position_of(destination, t_tx_s + travel_s))
            travel_s = float(np.linalg.norm(target - origin)) / self.settings.sound_speed_mps
        return travel_s

    def _launch(
        self, source: int, destination: int, now_s: float, duration_s: float, frame: bytes
    ) -> None:
        """Make every draw for one receiver and put the arrival on its way."""
        settings = self.settings
        link = (source, destination)
        travel_s = self.travel_time_s(source, destination, now_s)
        begins_s, ends_s = now_s + travel_s, now_s + travel_s + duration_s
        is_outlier = self._draw("outlier", link).random() < settings.outlier_share
        noise_m = settings.range_noise_m * self._draw("noise", link).standard_normal()
        factor = settings.outlier_factor if is_outlier else 1.0
        measured_s = now_s + factor * travel_s + noise_m / settings.sound_speed_mps
        measured_s += self._late_s(source, now_s) - self._late_s(destination, now_s)
        is_lost = self._packet_is_lost(link, len(frame), self._is_lost(link))
        is_lost |= 0.0 <= now_s / 60.0 - settings.silent_from_min < settings.silent_min
        is_corrupt = self._draw("corruption", link).random() < settings.corruption
        damaged = self._damage(link, frame)
        has_echo = self._draw("duplication", link).random() < settings.duplication
        fate = "lost" if is_lost else "corrupt" if is_corrupt else "delivered"
        if travel_s * settings.sound_speed_mps > settings.reach_m:
            fate = "out-of-reach"
        else:
            self._heard[destination].append(_Interval(source, begins_s, ends_s))
        delivery = Delivery(
            source=source,
            destination=destination,
            t_tx_s=now_s,
            t_rx_s=measured_s,
            t_delivered_s=max(begins_s, measured_s) + duration_s,
            frame=damaged if fate == "corrupt" else frame,
            fate=fate,
            sent=frame,
        )
        self._push(_Arrival(delivery, begins_s, ends_s, has_echo))

    def _late_s(self, node: int, now_s: float) -> float:
        """Return by how much a node's clock is behind that of node 0."""
        if node == 0:
            return 0.0
        return 1e-3 * self.settings.clock_offset_ms + 1e-6 * self.settings.clock_drift_ppm * now_s

    def _decide(self, arrival: _Arrival) -> Delivery:
        """Return the fate, now that everything that could sound at the same time has begun."""
        delivery, fate = arrival.delivery, arrival.delivery.fate
        if fate not in {"duplicate", "out-of-reach"}:
            if _overlaps(arrival, self._own[delivery.destination]):
                fate = "half-duplex"
            elif _overlaps(arrival, self._heard[delivery.destination]):
                fate = "collision"
        if fate not in {"delivered", "corrupt", "duplicate"}:
            return replace(delivery, t_rx_s=None, fate=fate)
        if arrival.echo and delivery.t_rx_s is not None:
            delay_s = self.settings.echo_delay_s
            echo = replace(
                delivery,
                t_rx_s=delivery.t_rx_s + delay_s,
                t_delivered_s=delivery.t_delivered_s + delay_s,
                fate="duplicate",
            )
            self._push(replace(arrival, delivery=echo, echo=False))
        return delivery

    def _is_lost(self, link: tuple[int, int]) -> bool:
        """Draw a loss, independent or by the Gilbert-Elliott state of this directed link."""
        settings = self.settings
        chance = self._draw("loss", link).random()
        turn = self._draw("spell", link).random()
        if settings.loss_model == "independent":
            return bool(chance < settings.loss)
        if link not in self._is_bad:
            self._is_bad[link] = bool(turn < settings.loss / settings.bad_state_loss)
        else:
            leaves = self._to_good if self._is_bad[link] else self._to_bad
            self._is_bad[link] ^= bool(turn < leaves)
        return self._is_bad[link] and bool(chance < settings.bad_state_loss)

    def _packet_is_lost(self, link: tuple[int, int], size_bytes: int, drawn: bool) -> bool:
        """Return whether a frame is lost: by its own draw, or that of its packet's first frame."""
        if self.settings.packet_frames == 1 or size_bytes < PACKED_BYTES:
            return drawn
        place, fate = self._packets.get(link, (0, drawn))
        fate = drawn if place == 0 else fate
        self._packets[link] = ((place + 1) % self.settings.packet_frames, fate)
        return fate

    def _damage(self, link: tuple[int, int], frame: bytes) -> bytes:
        """Return the frame with some bits turned; drawn for every frame, used for few."""
        rng = self._draw("damage", link)
        count = int(rng.geometric(1.0 / self.settings.corrupt_bits))
        positions = rng.integers(0, 1 << 62, size=min(count, 4096))
        damaged = bytearray(frame)
        for position in positions % max(8 * len(frame), 1) if frame else ():
            damaged[position >> 3] ^= 1 << (position & 7)
        if damaged == frame and damaged:  # an even number of turns of one bit
            damaged[0] ^= 1
        return bytes(damaged)

    def _draw(self, purpose: str, link: tuple[int, int]) -> np.random.Generator:
        key = (purpose, *link)
        if key not in self._generators:
            seed = (self._seed, PURPOSES.index(purpose), *link)
            self._generators[key] = np.random.default_rng(seed)
        return self._generators[key]

    def _push(self, arrival: _Arrival) -> None:
        self._sequence += 1
        heapq.heappush(self._queue, (arrival.delivery.t_delivered_s, self._sequence, arrival))

    def _forget(self, before_s: float) -> None:
        for sounds in (*self._own.values(), *self._heard.values()):
            while sounds and sounds[0].ends_s < before_s:
                del sounds[0]


def _overlaps(arrival: _Arrival, sounds: list[_Interval]) -> bool:
    """Return whether any other sound falls into the arrival's time at its receiver."""
    itself = (arrival.delivery.source, arrival.begins_s)
    return any(
        sound.begins_s < arrival.ends_s
        and sound.ends_s > arrival.begins_s
        and (sound.source, sound.begins_s) != itself
        for sound in sounds
    )


def _spell_probabilities(settings: WaterSettings) -> tuple[float, float]:
    """Return the chances per frame to enter and to leave a bad spell.

    The share of bad states is loss / bad_state_loss, and a bad spell lasts burst_frames on average.
    """
    if settings.loss_model == "independent":
        return 0.0, 0.0
    share_bad = settings.loss / settings.bad_state_loss
    leaving = 1.0 / settings.burst_frames
    if share_bad >= 1.0:
        entering = np.inf
    else:
        entering = share_bad * leaving / (1.0 - share_bad)
    if entering > 1.0:
        raise ConfigError(
            f"loss {settings.loss} cannot come in spells of {settings.burst_frames} frames;"
            f" give burst_frames of at least {share_bad / max(1.0 - share_bad, 1e-9):.1f}"
        )
    return entering, leaving
