"""Is the right modem at the other end of the line: a verdict of one line after two seconds."""

import re
from dataclasses import dataclass

from protocol.modems import nmea

IDENTIFY_S = 2.0
"""A modem that is there, at the right speed, answers its first question well within this."""
CROSS_PROBE_S = 1.0
"""After this much without a sound answer the other dialects' questions are asked, once."""
KEPT_BYTES = 1024
"""What is kept of the bytes before identification; enough for several answers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Fingerprint:
    """A question that every modem of a dialect answers, and what its talk looks like."""

    probe: bytes
    talk: re.Pattern[bytes]
    baud: int


FINGERPRINTS: dict[str, Fingerprint] = {
    "micromodem": Fingerprint(
        probe=b"\r\n" + nmea.encode("CCCFQ", "SRC"),
        talk=re.compile(rb"\$(CA|SN)[A-Z]{3},"),
        baud=19_200,
    ),
    "nanomodem": Fingerprint(
        probe=b"$?", talk=re.compile(rb"#A\d{3}(V\d{5})?[\r\n]|(^|[\r\n])E[\r\n]"), baud=9_600
    ),
}
"""The dialects that can be told apart; a new one may add itself here."""


class Identification:
    """Watches the line until the core has heard something sound, or two seconds are over."""

    def __init__(self, name: str, path: str, baud: int) -> None:
        self._name, self._path, self._baud = name, path, baud
        self._since_s: float | None = None
        self._heard = bytearray()
        self._probed = False
        self.verdict: str | None = None

    def receive_data(self, data: bytes) -> None:
        """Keep what came, for the verdict."""
        self._heard += data[: KEPT_BYTES - len(self._heard)]

    def poll(self, now_s: float, *, identified: bool) -> bytes:
        """Return the other dialects' questions when it is time; form the verdict at the end."""
        if identified:
            self.verdict = None
            return b""
        if self._since_s is None:
            self._since_s = now_s
        waited_s = now_s - self._since_s
        if waited_s >= IDENTIFY_S:
            self.verdict = self._judge()
        if waited_s < CROSS_PROBE_S or self._probed:
            return b""
        self._probed = True
        return b"".join(f.probe for name, f in FINGERPRINTS.items() if name != self._name)

    def _judge(self) -> str:
        heard = bytes(self._heard)
        for name, fingerprint in FINGERPRINTS.items():
            if name != self._name and fingerprint.talk.search(heard):
                return f"{self._path} answers like a {name}; open it as {name}://{self._path}"
        usual = ", ".join(f"{name} {f.baud}" for name, f in FINGERPRINTS.items())
        if heard:
            return (
                f"{self._path}: {len(heard)} bytes came that are no {self._name} at {self._baud}"
                f" baud; the speed is probably another, set ?baud= (usual: {usual})"
            )
        return (
            f"{self._path}: no answer from a {self._name} in {IDENTIFY_S:g} s at {self._baud} baud;"
            f" check its power and the cable, then ?baud= (usual: {usual})"
        )
