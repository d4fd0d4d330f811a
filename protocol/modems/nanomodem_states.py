"""The Nanomodem conversation as one table, its waits, and how the driver is to use the modem."""

import enum
from dataclasses import dataclass

from protocol.settings import Settings, setting

BROADCAST = -1


class State(enum.Enum):
    """What the driver is waiting for."""

    CLOSED = "closed"
    LISTENING = "listening"
    ADDRESSING = "addressing"
    IDLE = "idle"
    ASKING_ALIVE = "asking alive"
    SPEAKING = "speaking"
    ON_AIR = "on air"
    AWAITING = "awaiting"
    ASKING_QUALITY = "asking quality"


WAITS_S: dict[State, float] = {
    State.LISTENING: 1.0,
    State.ADDRESSING: 1.0,
    State.ASKING_ALIVE: 1.0,
    State.SPEAKING: 1.0,
    State.AWAITING: 6.0,
    State.ASKING_QUALITY: 1.0,
}
"""Local answers come within milliseconds; a peer's within the modem's own 4 s and two packets."""

TABLE: dict[tuple[State, str], tuple[str, State]] = {
    (State.CLOSED, "start"): ("ask_alive", State.LISTENING),
    (State.LISTENING, "gone"): ("ask_alive", State.LISTENING),
    (State.LISTENING, "#A"): ("set_address", State.ADDRESSING),
    (State.ADDRESSING, "#A"): ("rest", State.IDLE),
    (State.ADDRESSING, "gone"): ("ask_alive", State.LISTENING),
    (State.ADDRESSING, "E"): ("ask_alive", State.LISTENING),
    (State.IDLE, "alive?"): ("ask_alive", State.ASKING_ALIVE),
    (State.IDLE, "quality?"): ("ask_quality", State.ASKING_QUALITY),
    (State.IDLE, "request"): ("send_request", State.SPEAKING),
    (State.IDLE, "frame"): ("send_frame", State.SPEAKING),
    (State.ASKING_ALIVE, "#A"): ("check_address", State.IDLE),
    (State.ASKING_ALIVE, "gone"): ("fail", State.IDLE),
    (State.ASKING_ALIVE, "E"): ("fail", State.IDLE),
    (State.ASKING_QUALITY, "$C"): ("note_quality", State.IDLE),
    (State.ASKING_QUALITY, "E"): ("rest", State.IDLE),
    (State.ASKING_QUALITY, "gone"): ("fail", State.IDLE),
    (State.SPEAKING, "nothing"): ("rest", State.IDLE),
    (State.SPEAKING, "echo"): ("note_echo", State.ON_AIR),
    (State.SPEAKING, "E"): ("refuse", State.IDLE),
    (State.SPEAKING, "gone"): ("fail", State.IDLE),
    (State.ON_AIR, "aired"): ("note_aired", State.IDLE),
    (State.ON_AIR, "answer due"): ("rest", State.AWAITING),
    (State.ON_AIR, "E"): ("refuse", State.IDLE),
    (State.ON_AIR, "#R"): ("note_range", State.IDLE),
    (State.ON_AIR, "#TO"): ("note_silence", State.IDLE),
    (State.ON_AIR, "volts"): ("rest", State.IDLE),
    (State.AWAITING, "#R"): ("note_range", State.IDLE),
    (State.AWAITING, "#TO"): ("note_silence", State.IDLE),
    (State.AWAITING, "volts"): ("rest", State.IDLE),
    (State.AWAITING, "gone"): ("note_silence", State.IDLE),
    (State.IDLE, "dead"): ("ask_alive", State.LISTENING),
    (State.IDLE, "foreign"): ("set_address", State.ADDRESSING),
}
"""State and trigger to action and next state; an unlisted pair changes nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NanomodemSettings(Settings):
    """Address and manners; every key can be written in the URL."""

    address: int = setting(1, "", "our address", minimum=0, maximum=255)
    destination: int = setting(
        BROADCAST, "", "-1 reaches every vehicle by broadcast", minimum=-1, maximum=255
    )
    acknowledge: bool = setting(
        False, "", "with a destination: have the modem confirm each frame and measure the range"
    )
    quality: bool = setting(True, "", "ask after each packet how many bytes were corrected")
    queue_frames: int = setting(
        64, "frames", "four sub-maps of small frames", minimum=1, maximum=4096
    )
    baud: int = setting(9600, "bit/s", "the modem's only speed", minimum=300, maximum=921600)
    pause_s: float = setting(
        1.0, "s", "first pause after a refusal; it doubles up to 16 s", minimum=0.1
    )
