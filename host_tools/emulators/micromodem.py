"""An emulated WHOI Micro-Modem 1 or 2, without I/O: sentences in, sentences and packets out.

Choices where the public grammar leaves a hole are listed in `host_tools/emulators/README.md`.
"""

from datetime import UTC, datetime

from host_tools.emulators.bench import AirPacket
from host_tools.emulators.micromodem_firmware import flexible_s, packet_s
from host_tools.emulators.micromodem_radio import DIALECT, Cycle, MicroModemRadio
from protocol.modems.micromodem_settings import FRAMES_AND_BYTES
from protocol.modems.nmea import Sentence

CLOCK_QUERY_S = 0.5
"""The answer to a clock query comes about this late."""

COMMANDS: dict[str, str] = {
    "CCCFG": "setting",
    "CCCFQ": "query",
    "CCCLK": "old_clock",
    "CCTMS": "new_clock",
    "CCTMQ": "clock_query",
    "CCMSC": "reboot",
    "CCCYC": "cycle",
    "CCTXD": "data",
    "CCTDP": "flexible",
    "CCMPC": "ping",
    "CCMUC": "mini",
}
"""Sentence to the method `_do_...`."""


class MicroModemUnit(MicroModemRadio):
    """One modem on the bench, as its host commands it."""

    def _obey(self, sentence: Sentence, now_s: float) -> None:
        command = COMMANDS.get(sentence.name)
        newer = sentence.name in {"CCTDP", "CCTMS", "CCTMQ"}
        missing = newer and not self.quirks.is_second_generation
        if command is None or missing or self.quirks.refuses_all:
            self._error(now_s, "NMEA", 2, "Invalid sentence")
            return
        try:
            getattr(self, "_do_" + command)(list(sentence.fields), now_s)
        except (IndexError, ValueError, KeyError):
            self._error(now_s, "NMEA", 4, "Bad field")

    def _do_setting(self, fields: list[str], now_s: float) -> None:
        key, value = fields[0], fields[1]
        if key not in self.settings:
            self._error(now_s, "NMEA", 6, f"Unknown setting {key}")
            return
        self.settings[key] = value
        self._say(now_s, "CACFG", key, value)

    def _do_query(self, fields: list[str], now_s: float) -> None:
        if fields[0] in {"ALL", "TOP"}:
            if (fields[0] == "TOP") != self.quirks.is_second_generation:
                self._error(now_s, "NMEA", 6, f"Unknown setting {fields[0]}")
                return
            for index, (key, value) in enumerate(self.settings.items()):
                self._say(now_s, "CACFG", key, value)
                if index == 20 and self.quirks.heartbeat_in_dump:
                    self._say(now_s, "CAREV", self.clock.hhmmss(now_s), "AUV", self.quirks.firmware)
            return
        self._say(now_s, "CACFG", fields[0], self.settings[fields[0]])

    def _do_old_clock(self, fields: list[str], now_s: float) -> None:
        self.clock.set(datetime(*map(int, fields[:6]), tzinfo=UTC), now_s)  # type: ignore[misc, arg-type]
        self._say(now_s, "CACLK", *fields[:6])

    def _do_new_clock(self, fields: list[str], now_s: float) -> None:
        self.clock.set(datetime.fromisoformat(fields[0]).astimezone(UTC), now_s)
        self._say(now_s, "CATMS", 0, fields[0])

    def _do_clock_query(self, _fields: list[str], now_s: float) -> None:
        told = self.clock.read(now_s).strftime("%Y-%m-%dT%H:%M:%SZ")
        pulse = "EXT" if self.clock.pulse_present else "RTC"
        source = "USER_CMD" if self.clock.is_set else "NONE"
        self._at(now_s + CLOCK_QUERY_S, lambda t: self._say(t, "CATMQ", told, source, pulse))

    def _do_reboot(self, fields: list[str], now_s: float) -> None:
        self._say(now_s, "CAMSC", *fields[:3])
        self._at(now_s + 0.1, self.power_cycle)

    def _do_cycle(self, fields: list[str], now_s: float) -> None:
        source, destination, rate = int(fields[1]), int(fields[2]), int(fields[3])
        acknowledge, count = fields[4] == "1", int(fields[5])
        most, _ = FRAMES_AND_BYTES[rate]
        if source != self.address or not 1 <= count <= most:
            raise ValueError
        if self._cycle is not None or now_s < self._busy_until_s:
            self._error(now_s, "MODEM", 9, "BUSY")
            return
        self._say(now_s, "CACYC", *fields[:6])
        self._cycle = Cycle(destination, rate, acknowledge, count)
        for frame in self._preloaded[:count]:
            self._cycle.frames.append(frame)
        self._preloaded = []
        self._ask_data(now_s)

    def _ask_data(self, now_s: float) -> None:
        cycle = self._cycle
        assert cycle is not None
        if len(cycle.frames) == cycle.count:
            self._launch_cycle(now_s)
            return
        _, size = FRAMES_AND_BYTES[cycle.rate]
        number = len(cycle.frames) + 1
        cycle.deadline_s = now_s + float(self.settings["DTO"])
        source, ack = self.address, int(cycle.acknowledge)
        told = self.clock.hhmmss(now_s)
        self._say(now_s, "CADRQ", told, source, cycle.destination, ack, size, number)

    def _do_data(self, fields: list[str], now_s: float) -> None:
        frame = bytes.fromhex(fields[3])
        cycle = self._cycle
        size = FRAMES_AND_BYTES[cycle.rate][1] if cycle is not None else 256
        if len(frame) > size:
            raise ValueError
        self._say(now_s, "CATXD", *fields[:3], len(frame))
        if cycle is None:
            self._preloaded = [*self._preloaded[-7:], frame]
        elif frame:
            cycle.frames.append(frame)
            self._ask_data(now_s)
        else:
            cycle.count = len(cycle.frames)
            self._ask_data(now_s)

    def _launch_cycle(self, now_s: float) -> None:
        cycle, self._cycle = self._cycle, None
        assert cycle is not None
        if not cycle.frames:
            return
        packet = AirPacket(
            dialect=DIALECT,
            kind="data",
            source=self.address,
            destination=cycle.destination,
            airtime_s=packet_s(cycle.rate, len(cycle.frames)),
            frames=tuple(cycle.frames),
            rate=cycle.rate,
            acknowledge=cycle.acknowledge,
        )
        self._launch(packet, now_s)

    def _do_flexible(self, fields: list[str], now_s: float) -> None:
        destination, rate, acknowledge = int(fields[0]), int(fields[1]), fields[2] == "1"
        frame = bytes.fromhex(fields[4])
        busy = self._cycle is not None or now_s < self._busy_until_s
        odd = self.quirks.needs_even_bytes and len(frame) % 2 == 1
        error = 1 if busy else 2 if odd or not 0 < len(frame) <= 2048 else 0
        self._uid += 1
        self._say(now_s, "CATDP", error, self._uid, *fields[:4], 0, len(frame))
        if error == 0:
            packet = AirPacket(
                dialect=DIALECT,
                kind="flexible",
                source=self.address,
                destination=destination,
                airtime_s=flexible_s(rate, len(frame)),
                frames=(frame,),
                rate=rate,
                acknowledge=acknowledge,
            )
            self._launch(packet, now_s)

    def _do_ping(self, fields: list[str], now_s: float) -> None:
        self._say(now_s, "CAMPC", *fields[:2])
        self._launch(self._control("ping", int(fields[1])), now_s)

    def _do_mini(self, fields: list[str], now_s: float) -> None:
        value = int(fields[2], 16)
        if value > 0x1FFF:
            raise ValueError
        self._say(now_s, "CAMUC", *fields[:3])
        self._launch(self._control("mini", int(fields[1]), value.to_bytes(2, "big")), now_s)
