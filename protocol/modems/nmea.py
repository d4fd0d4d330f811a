"""NMEA-0183 sentences with checksum: fields to bytes, and any bytes back to sentences.

A sentence is `$` body `*` XX and a terminator; XX is the exclusive or of the body's bytes in
upper-case hexadecimal. Source: NMEA-0183 as the Micro-Modem speaks it.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

LONGEST_BYTES = 8_192
"""Cap of one line: a flexible packet of 2048 bytes takes 4,200 characters; twice that is noise."""

QUEUED_SENTENCES = 256
"""Cap of parsed sentences that nobody has fetched: a whole configuration dump has about 120."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sentence:
    """One sound sentence: its first field as `name` (talker and type) and the fields after it."""

    name: str
    fields: tuple[str, ...]


def checksum(body: bytes) -> int:
    """Return the exclusive or of all bytes between `$` and `*`."""
    return int(np.bitwise_xor.reduce(np.frombuffer(body, dtype=np.uint8), initial=0))


def encode(name: str, *fields: str | int) -> bytes:
    """Return a sentence with checksum and the terminator CR LF."""
    body = ",".join([name, *map(str, fields)]).encode("ascii")
    return b"$%s*%02X\r\n" % (body, checksum(body))


def decode(line: bytes, *, need_checksum: bool = True) -> Sentence | None:
    """Return the sentence in a line without its terminator, or None when it is not sound.

    A line that lost its end runs into the next one: what counts then is the last `$`. A line
    without a checksum passes only where `need_checksum` is off (a modem takes them from hosts).
    """
    start = line.rfind(b"$")
    if start < 0:
        return None
    body, star, digits = line[start + 1 :].rpartition(b"*")
    if star:
        try:
            expected = int(digits.strip()[:2], 16) if len(digits.strip()) == 2 else -1
        except ValueError:
            return None
        if expected != checksum(body):
            return None
    elif need_checksum:
        return None
    else:
        body = digits
    if not body or not body.isascii() or not body.decode("ascii").isprintable():
        return None
    name, *fields = body.decode("ascii").split(",")
    return Sentence(name=name, fields=tuple(fields))


class SentenceReader:
    """Bytes in, sentences out; what is not a sound sentence is counted and dropped.

    Any of CR LF, LF and CR ends a line, since serial ports and sockets of one modem differ.
    """

    def __init__(self, *, need_checksum: bool = True) -> None:
        self._need_checksum = need_checksum
        self._line = bytearray()
        self._sentences: deque[Sentence] = deque(maxlen=QUEUED_SENTENCES)
        self.sound_count = 0
        self.damaged_count = 0
        self.unread_count = 0

    def receive_data(self, data: bytes) -> None:
        """Take bytes in any chunking."""
        for part in data.replace(b"\r", b"\n").splitlines(keepends=True):
            # bytes.splitlines breaks at CR and LF only, unlike str.splitlines.
            self._line += part
            if len(self._line) > LONGEST_BYTES:
                self.damaged_count += 1
                self._line.clear()
            elif part.endswith(b"\n"):
                self._finish(bytes(self._line[:-1]))
                self._line.clear()

    def next_sentence(self) -> Sentence | None:
        """Return the oldest sentence not yet fetched."""
        return self._sentences.popleft() if self._sentences else None

    def clear(self) -> None:
        """Forget the unfinished line, after the port or the modem was gone."""
        self._line.clear()

    def _finish(self, line: bytes) -> None:
        if not line.strip(b"\x00 "):
            return
        sentence = decode(line, need_checksum=self._need_checksum)
        if sentence is None:
            self.damaged_count += 1
            return
        self.sound_count += 1
        self.unread_count += len(self._sentences) == QUEUED_SENTENCES
        self._sentences.append(sentence)
