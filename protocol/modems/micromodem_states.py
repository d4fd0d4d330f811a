"""The Micro-Modem conversation as one table: state and trigger to action and next state.

A trigger is the name of a sentence, or one of: `start` (port there), `silence` (the wait of a dump
is over), `done` (an action finished its list), `nothing` (no frame may go), `gone` (no answer after
all tries), `refused` (an error line or a wrong echo), `restarted` (the modem says so). An unlisted
pair changes nothing.
"""

import enum
from dataclasses import dataclass


class State(enum.Enum):
    """What the driver is waiting for."""

    CLOSED = "closed"
    LISTENING = "listening"
    BOOTING = "booting"
    DUMPING = "dumping"
    CONFIGURING = "configuring"
    SETTING_CLOCK = "setting clock"
    CHECKING_CLOCK = "checking clock"
    IDLE = "idle"
    ASKING_ALIVE = "asking alive"
    CYCLE_ASKED = "cycle asked"
    LOADING = "loading"
    FLEXIBLE_ASKED = "flexible asked"
    LOADED = "loaded"
    SENDING = "sending"
    PINGING = "pinging"
    MINI_ASKED = "mini asked"


@dataclass(frozen=True, slots=True, kw_only=True)
class Wait:
    """How long a state waits for its next trigger, how often it asks again, and what then."""

    seconds: float
    tries: int
    then: str


WAITS: dict[State, Wait] = {
    State.LISTENING: Wait(seconds=1.0, tries=1, then="gone"),
    State.BOOTING: Wait(seconds=2.0, tries=1, then="silence"),
    State.DUMPING: Wait(seconds=2.0, tries=1, then="silence"),
    State.CONFIGURING: Wait(seconds=5.0, tries=3, then="gone"),
    State.SETTING_CLOCK: Wait(seconds=5.0, tries=3, then="gone"),
    State.CHECKING_CLOCK: Wait(seconds=5.0, tries=3, then="gone"),
    State.ASKING_ALIVE: Wait(seconds=5.0, tries=3, then="gone"),
    State.CYCLE_ASKED: Wait(seconds=5.0, tries=1, then="gone"),
    State.LOADING: Wait(seconds=5.0, tries=1, then="gone"),
    State.FLEXIBLE_ASKED: Wait(seconds=5.0, tries=1, then="gone"),
    State.LOADED: Wait(seconds=5.0, tries=1, then="gone"),
    State.SENDING: Wait(seconds=10.0, tries=1, then="gone"),
    State.PINGING: Wait(seconds=20.0, tries=1, then="gone"),
    State.MINI_ASKED: Wait(seconds=5.0, tries=1, then="gone"),
}
"""Five seconds and three tries for questions, ten for a packet (3 s and up to 5 s of queue); a
ping over 10 km takes 13.4 s both ways. A packet is never asked twice by time-out: its second of
transmission would be wrong; it goes back to the queue instead."""

_UP = (
    State.BOOTING,
    State.DUMPING,
    State.CONFIGURING,
    State.SETTING_CLOCK,
    State.CHECKING_CLOCK,
    State.IDLE,
    State.ASKING_ALIVE,
    State.CYCLE_ASKED,
    State.LOADING,
    State.FLEXIBLE_ASKED,
    State.LOADED,
    State.SENDING,
    State.PINGING,
    State.MINI_ASKED,
)

Row = tuple[str, State]
TABLE: dict[tuple[State, str], Row] = {
    (State.CLOSED, "start"): ("ask_alive", State.LISTENING),
    (State.LISTENING, "heard"): ("ask_dump", State.DUMPING),
    (State.LISTENING, "gone"): ("ask_alive", State.LISTENING),
    (State.BOOTING, "booted"): ("ask_dump", State.DUMPING),
    (State.BOOTING, "silence"): ("ask_dump", State.DUMPING),
    (State.DUMPING, "CACFG"): ("note_setting", State.DUMPING),
    (State.DUMPING, "refused"): ("ask_other_dump", State.DUMPING),
    (State.DUMPING, "silence"): ("ask_next_setting", State.CONFIGURING),
    (State.CONFIGURING, "CACFG"): ("check_setting", State.CONFIGURING),
    (State.CONFIGURING, "refused"): ("skip_setting", State.CONFIGURING),
    (State.CONFIGURING, "done"): ("plan_clock", State.SETTING_CLOCK),
    (State.SETTING_CLOCK, "CACLK"): ("ask_clock", State.CHECKING_CLOCK),
    (State.SETTING_CLOCK, "CATMS"): ("ask_clock", State.CHECKING_CLOCK),
    (State.SETTING_CLOCK, "refused"): ("plan_other_clock", State.SETTING_CLOCK),
    (State.SETTING_CLOCK, "done"): ("rest", State.IDLE),
    (State.CHECKING_CLOCK, "CATMQ"): ("check_clock", State.CHECKING_CLOCK),
    (State.CHECKING_CLOCK, "refused"): ("rest", State.IDLE),
    (State.CHECKING_CLOCK, "done"): ("rest", State.IDLE),
    (State.CHECKING_CLOCK, "wrong"): ("plan_clock", State.SETTING_CLOCK),
    (State.IDLE, "alive?"): ("ask_alive", State.ASKING_ALIVE),
    (State.IDLE, "clock?"): ("plan_clock", State.SETTING_CLOCK),
    (State.IDLE, "packet"): ("ask_cycle", State.CYCLE_ASKED),
    (State.IDLE, "flexible"): ("send_flexible", State.FLEXIBLE_ASKED),
    (State.IDLE, "ping"): ("send_ping", State.PINGING),
    (State.IDLE, "mini"): ("send_mini", State.MINI_ASKED),
    (State.ASKING_ALIVE, "CACFG"): ("check_address", State.ASKING_ALIVE),
    (State.ASKING_ALIVE, "done"): ("rest", State.IDLE),
    (State.ASKING_ALIVE, "wrong"): ("ask_dump", State.DUMPING),
    (State.CYCLE_ASKED, "nothing"): ("rest", State.IDLE),
    (State.CYCLE_ASKED, "CACYC"): ("rest", State.LOADING),
    (State.CYCLE_ASKED, "CADRQ"): ("load_frame", State.LOADING),
    (State.CYCLE_ASKED, "refused"): ("refuse_packet", State.IDLE),
    (State.LOADING, "CADRQ"): ("load_frame", State.LOADING),
    (State.LOADING, "done"): ("rest", State.LOADED),
    (State.LOADING, "refused"): ("refuse_packet", State.IDLE),
    (State.LOADING, "late"): ("note_late", State.IDLE),
    (State.FLEXIBLE_ASKED, "nothing"): ("rest", State.IDLE),
    (State.FLEXIBLE_ASKED, "CATDP"): ("check_flexible", State.FLEXIBLE_ASKED),
    (State.FLEXIBLE_ASKED, "done"): ("rest", State.LOADED),
    (State.FLEXIBLE_ASKED, "refused"): ("refuse_flexible", State.IDLE),
    (State.LOADED, "CADRQ"): ("load_nothing", State.LOADED),
    (State.LOADED, "CATXP"): ("note_start", State.SENDING),
    (State.LOADED, "CATXF"): ("note_sent", State.IDLE),
    (State.LOADED, "refused"): ("refuse_packet", State.IDLE),
    (State.SENDING, "CATXF"): ("note_sent", State.IDLE),
    (State.SENDING, "refused"): ("refuse_packet", State.IDLE),
    (State.PINGING, "CAMPR"): ("note_range", State.IDLE),
    (State.PINGING, "gone"): ("note_no_range", State.IDLE),
    (State.PINGING, "refused"): ("note_no_range", State.IDLE),
    (State.MINI_ASKED, "CAMUC"): ("rest", State.IDLE),
    (State.MINI_ASKED, "refused"): ("drop_mini", State.IDLE),
    (State.MINI_ASKED, "gone"): ("drop_mini", State.IDLE),
}
for _state in (State.CYCLE_ASKED, State.LOADING, State.FLEXIBLE_ASKED, State.LOADED, State.SENDING):
    TABLE[_state, "gone"] = ("fail_packet", State.IDLE)
for _state in _UP:
    TABLE[_state, "restarted"] = ("restart", State.BOOTING)
    TABLE[_state, "lost"] = ("rest", State.CLOSED)
    TABLE[_state, "dead"] = ("declare_dead", State.LISTENING)
    TABLE.setdefault((_state, "gone"), ("declare_dead", State.LISTENING))
TABLE[State.LISTENING, "lost"] = ("rest", State.CLOSED)
