"""WHOI Micro-Modem 1 and 2: the sans-IO core that the generic driver runs over a serial port.

The table is `micromodem_states`; its actions are `micromodem_setup` (identify, configure, clock)
and `micromodem_traffic` (data cycle, flexible packets, pings, reception). Grammar and timers come
from open drivers and the public guide; WHOI has not confirmed them.
"""

from protocol.errors import LocalProtocolError
from protocol.modems.base import Modem, ModemContext, ModemUrl
from protocol.modems.dialect_driver import ALIVE_QUERY_S, open_dialect, settings_from_url
from protocol.modems.micromodem_machine import NOTHING
from protocol.modems.micromodem_settings import MicroModemSettings
from protocol.modems.micromodem_states import State
from protocol.modems.micromodem_traffic import Traffic


class MicroModem(Traffic):
    """Bytes and time in; bytes for the modem and events out."""

    def poll(self, now_s: float) -> bytes:
        """Return what must be said to the modem now."""
        if self.state is State.CLOSED:
            self._fire("start", NOTHING, now_s)
        if self.packet.overdue(now_s):
            self._events.extend(self.packet.finish(None, now_s))
        self._run_waits(now_s)
        if self.state is State.IDLE:
            self._choose(now_s)
        output, self._output = bytes(self._output), bytearray()
        return output

    def next_wakeup_s(self, now_s: float) -> float:
        """Return when `poll` will next have something to do, if nothing is heard before."""
        if self.state is State.CLOSED:
            return now_s
        times = [self._deadline_s, self.packet.deadline_s]
        if self._later is not None:
            times.append(self._later[0])
        if self.state is State.IDLE:
            times.append(self._heard_s + ALIVE_QUERY_S)
            if self._requests:
                times.append(self._pause_until_s)
            if not self.clock.is_set:
                times.append(max(self._clock_retry_s, self._pause_until_s))
            times.append(max(self._begin_s(max(now_s, self._pause_until_s)), now_s))
        return max(now_s, min(times))

    def send(self, frame: bytes, now_s: float, start_s: float | None = None) -> None:
        """Queue a frame to start on the first whole second that leaves time to load it.

        With start_s it starts on that second or later; hand it over `lead_s` before.

        Raises
        ------
        LocalProtocolError
            When the rate's frames are smaller.
        """
        self._check_size(frame)
        self.outbox.put(frame, now_s if start_s is None else start_s)

    def ping(self, peer: int) -> None:
        """Ask for a two-way range; RangeMeasured or PeerSilent follows."""
        self._requests.append(("ping", peer, 0))

    def mini(self, peer: int, value: int) -> None:
        """Send 13 bits to a peer.

        Raises
        ------
        LocalProtocolError
            When the value needs more.
        """
        if not 0 <= value <= 0x1FFF:
            raise LocalProtocolError(f"mini-packet {value:#x}: 13 bits hold 0 to 0x1fff")
        self._requests.append(("mini", peer, value))

    @property
    def lead_s(self) -> float:
        """How long before its second of transmission a full packet must be handed over."""
        return self._lead_of([self.frame_bytes] * self.frames_per_packet, flexible=False)

    @property
    def ready(self) -> bool:
        """Whether the modem is configured and answers."""
        return self.identified and self.state not in NOT_READY


NOT_READY = frozenset(
    {State.CLOSED, State.LISTENING, State.BOOTING, State.DUMPING, State.CONFIGURING}
)


def open_micromodem(url: ModemUrl, context: ModemContext) -> Modem:
    """Return the modem of micromodem:///dev/ttyUSB0?address=2&rate=4.

    Raises
    ------
    ConfigError
        For an unknown option or a value out of bounds.
    ModemUnavailable
        When the port is not there.
    """
    settings = settings_from_url(url, MicroModemSettings())
    return open_dialect(url, context, settings.baud, lambda: MicroModem(settings, context.stamp))
