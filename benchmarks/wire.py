"""What the wire costs: python -m benchmarks.wire prints microseconds per frame, one thread."""

import timeit
from collections.abc import Callable

from protocol import vectors
from protocol.codec import decode, encode
from protocol.crc import crc32c
from protocol.framing import LineReader, wrap
from protocol.layouts import FRAMES
from protocol.packets import Packet, Profile, SealedFrame, SubmapPacket
from protocol.seal import Blake2sSuite, Keys, Opener, Sealer


class _Count:
    def __init__(self) -> None:
        self.number = 0

    def next(self) -> int:
        self.number += 1
        return self.number


def best_us(call: Callable[[], object], number: int = 2000) -> float:
    """Return the best of seven means, in microseconds."""
    return 1e6 * min(timeit.repeat(call, number=number, repeat=7)) / number


def main() -> None:
    """Print the table."""
    paper = vectors.packets()["paper"]
    assert isinstance(paper, SubmapPacket)
    frame = encode(paper)
    answer = encode(vectors.packets()["answer"])
    line = wrap(frame)
    layout = FRAMES[Profile.SUBMAP_PAPER]
    keys = Keys(vectors.SEAL_KEY)
    short: Packet = vectors.sealed()["paper, sealed"][1]
    sealer = Sealer(keys, _Count())
    sealed = decode(sealer.seal(short))
    assert isinstance(sealed, SealedFrame)
    key = keys.direction(2, 0)

    def read_line() -> None:
        LineReader().receive_data(line)

    rows: list[tuple[str, Callable[[], object], int]] = [
        ("decode, 256-byte paper frame", lambda: decode(frame), 2000),
        ("decode, 22-byte answer", lambda: decode(answer), 2000),
        ("encode, 256-byte paper frame", lambda: encode(paper), 2000),
        ("construct parses the same frame", lambda: layout.parse(frame), 200),
        ("CRC-32C of 252 bytes", lambda: crc32c(frame[:-4]), 2000),
        ("COBS, write", lambda: wrap(frame), 2000),
        ("COBS, read", read_line, 2000),
        ("seal with BLAKE2s, encode", lambda: sealer.seal(short), 2000),
        ("verify and open with BLAKE2s", lambda: Opener(0, keys).open(sealed), 2000),
        ("BLAKE2s tag alone", lambda: Blake2sSuite().protect(key, b"", sealed.body, 1), 2000),
    ]
    for name, call, number in rows:
        print(f"{name:34s} {best_us(call, number):8.2f} us")


if __name__ == "__main__":
    main()
