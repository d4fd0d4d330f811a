"""An adaptive binary arithmetic coder whose code may be cut anywhere and still be read so far.

Range coder with a 32-bit range and carry. The probability of a one in a context is (ones + 0.4) /
(all + 0.8) of what was coded there before, in 1/65536; counts are halved at 255, so that contexts
forget. The decoder knows how many bytes it has: a decision that missing bytes could change is not
taken, `CodeEnd` is raised instead.
"""

from collections.abc import Iterable
from copy import copy

_TOP = 1 << 24
_ALL = 0xFFFFFFFF
_FORGET = 255


class CodeEnd(Exception):  # noqa: N818  the ordinary end of a code, not an error
    """The bytes at hand decide no further symbol."""


class Contexts:
    """The counts of zeros and ones seen in each context."""

    def __init__(self, count: int) -> None:
        self._ones = [0] * count
        self._all = [0] * count

    def share(self, context: int) -> int:
        """Return the probability of a one in 1/65536, from 1 to 65535."""
        return (65536 * (5 * self._ones[context] + 2)) // (5 * self._all[context] + 4)

    def count(self, context: int, bit: int) -> None:
        """Remember a symbol."""
        self._ones[context] += bit
        self._all[context] += 1
        if self._all[context] >= _FORGET:
            self._ones[context] //= 2
            self._all[context] //= 2


class Encoder:
    """Bits in, bytes out."""

    def __init__(self) -> None:
        self._low = 0
        self._range = _ALL
        self._out = bytearray()
        self._cache = 0
        self._pending = 0  # bytes of 0xff that a carry may still turn over
        self._started = False

    def __len__(self) -> int:
        """Return about how many bytes were coded so far."""
        return len(self._out) + self._pending + 1

    def copied(self) -> "Encoder":
        """Return a coder that goes on from here by itself."""
        out = copy(self)
        out._out = self._out[:]  # noqa: SLF001  one of us
        return out

    def encode(self, bit: int, share: int) -> None:
        """Code a bit whose probability of being one is share / 65536."""
        bound = (self._range >> 16) * share
        if bit:
            self._range = bound
        else:
            self._low += bound
            self._range -= bound
        while self._range < _TOP:
            self._range = self._range << 8 & _ALL
            self._shift()

    def encode_adaptive(self, bits: Iterable[int], where: Iterable[int], counts: Contexts) -> None:
        """Code bits, each in its context."""
        for bit, context in zip(bits, where, strict=True):
            self.encode(bit, counts.share(context))
            counts.count(context, bit)

    def encode_number(self, value: int, bits: int) -> None:
        """Code a number below 2^bits, each value equally likely."""
        for place in range(bits - 1, -1, -1):
            self.encode(value >> place & 1, 32768)

    def finish(self) -> bytes:
        """Return the code."""
        for _ in range(5):
            self._shift()
        return bytes(self._out)

    def _shift(self) -> None:
        if self._low < 0xFF000000 or self._low > _ALL:
            carry = self._low >> 32
            if self._started:
                self._out.append(self._cache + carry & 0xFF)
            self._started = True
            self._out.extend([0xFF + carry & 0xFF] * self._pending)
            self._pending = 0
            self._cache = self._low >> 24 & 0xFF
        else:
            self._pending += 1
        self._low = self._low << 8 & _ALL


class Decoder:
    """Bytes in, bits out, as far as the bytes reach."""

    def __init__(self, code: bytes) -> None:
        self._code = code
        self._at = 0
        self._range = _ALL
        self._value = 0
        self._slack = 0  # value may be larger by up to this, for bytes that are missing
        for _ in range(4):
            self._pull()

    def decode(self, share: int) -> int:
        """Return the next bit, whose probability of being one is share / 65536."""
        bound = (self._range >> 16) * share
        if self._value + self._slack < bound:
            self._range = bound
            bit = 1
        elif self._value >= bound:
            self._value -= bound
            self._range -= bound
            bit = 0
        else:
            raise CodeEnd
        while self._range < _TOP:
            self._range = self._range << 8 & _ALL
            self._pull()
        return bit

    def decode_number(self, bits: int) -> int:
        """Return a number below 2^bits."""
        value = 0
        for _ in range(bits):
            value = value << 1 | self.decode(32768)
        return value

    def _pull(self) -> None:
        missing = self._at >= len(self._code)
        byte = 0 if missing else self._code[self._at]
        self._value = self._value << 8 | byte
        self._slack = self._slack << 8 | (0xFF if missing else 0)
        self._at += 1
