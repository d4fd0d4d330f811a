"""Frames as a capture file that Wireshark and tshark read with host_tools/wireshark."""

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import BinaryIO

USER0, USER1 = 147, 148
"""Link types of pcap for private use: bare frames; frames behind three bytes of the medium."""
FATES = ("delivered", "lost", "collision", "half-duplex", "corrupt", "duplicate", "out-of-reach")
OTHER_FATE = 255
LATEST_S = 2.0**32 - 1.0
"""Times of a capture are seconds of four bytes."""
_FILE = struct.Struct("<IHHiIII")
_RECORD = struct.Struct("<IIII")


@dataclass(frozen=True, slots=True, kw_only=True)
class Captured:
    """A frame at a time in seconds, 0 to LATEST_S.

    Node and fate are None where nothing is known of the medium.
    """

    time_s: float
    frame: bytes
    source: int | None = None
    destination: int | None = None
    fate: str = ""


def write_pcap(stream: BinaryIO, frames: Iterable[Captured]) -> int:
    """Write a capture and return how many frames it has; all with the medium's bytes, or none."""
    count = 0
    for record in _records(frames):
        if count == 0:
            link_type = USER0 if record[1] is None else USER1
            stream.write(_FILE.pack(0xA1B2C3D4, 2, 4, 0, 0, 65535, link_type))
        time_s, medium, frame = record
        data = (medium or b"") + frame
        micros = round(time_s * 1e6)
        stream.write(_RECORD.pack(micros // 1_000_000, micros % 1_000_000, len(data), len(data)))
        stream.write(data)
        count += 1
    return count


def _records(frames: Iterable[Captured]) -> Iterator[tuple[float, bytes | None, bytes]]:
    for captured in frames:
        if captured.source is None or captured.destination is None:
            yield captured.time_s, None, captured.frame
        else:
            fate = FATES.index(captured.fate) if captured.fate in FATES else OTHER_FATE
            medium = bytes([captured.source & 255, captured.destination & 255, fate])
            yield captured.time_s, medium, captured.frame
