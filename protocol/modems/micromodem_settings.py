"""The Micro-Modem's packet types, and how this driver is to use the modem."""

from dataclasses import dataclass

from protocol.settings import Settings, setting

FRAMES_AND_BYTES: dict[int, tuple[int, int]] = {
    0: (1, 32),
    1: (3, 64),
    2: (3, 64),
    3: (2, 256),
    4: (2, 256),
    5: (8, 256),
    6: (6, 32),
}
"""Frames per packet and bytes per frame of each rate."""

FLEXIBLE_BYTES = 100
"""Most bytes that a flexible packet is given; larger frames take the data cycle."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MicroModemSettings(Settings):
    """Address, rate and manners; every key can be written in the URL."""

    address: int = setting(1, "", "our address; 0 is broadcast", minimum=1, maximum=127)
    destination: int = setting(0, "", "0 reaches every vehicle", minimum=0, maximum=127)
    rate: int = setting(
        4, "", "PSK that carries two 256-byte frames; the paper's packet", minimum=0, maximum=6
    )
    flexible: bool = setting(
        True, "", "frames of up to 100 bytes go as flexible packets where the firmware has them"
    )
    flexible_rate: int = setting(1, "", "of flexible packets", minimum=1, maximum=5)
    acknowledge: bool = setting(False, "", "broadcasts cannot be acknowledged")
    utc_at_zero: str = setting(
        "2026-01-01T00:00:00Z", "", "UTC of mission time zero, the same on all vehicles"
    )
    queue_frames: int = setting(
        64, "frames", "four minutes of a follower's frames", minimum=1, maximum=4096
    )
    baud: int = setting(19200, "bit/s", "the modem's own default", minimum=300, maximum=921600)
    poll_period_s: float = setting(
        0.25,
        "s",
        "how seldom the vehicle's loop may poll; packets are begun earlier by it",
        minimum=0.0,
        maximum=0.5,
    )
    pause_s: float = setting(
        2.0, "s", "first pause after a failed packet; it doubles up to 16 s", minimum=0.1
    )
