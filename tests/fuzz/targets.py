"""What is fuzzed: one function per target, bytes in, nothing out, any exception a defect."""

from collections.abc import Callable
from contextlib import suppress

import numpy as np

from firmware.leader.reconstruction import ReconstructionSettings, reconstruct_packets
from protocol import vectors
from protocol.codec import decode, encode
from protocol.crc import with_crc
from protocol.errors import EstimationError, RemoteProtocolError
from protocol.framing import GUARD_BYTES, QUEUED_FRAMES, LineReader, wrap
from protocol.modems.micromodem import MicroModem
from protocol.modems.micromodem_settings import MicroModemSettings
from protocol.modems.nanomodem import Nanomodem
from protocol.modems.nanomodem_lines import ReplyReader
from protocol.modems.nanomodem_states import NanomodemSettings
from protocol.modems.nmea import SentenceReader
from protocol.packets import Header, Packet, Profile, SubmapFragment
from protocol.reassembly import FragmentArrived, Reassembler, ReassemblySettings
from protocol.seal import Keys, Opener

KEYS = Keys(vectors.SEAL_KEY)
GENUINE = {frame[:-4] for frame, _ in vectors.sealed().values()}
BODIES = {
    Profile.SUBMAP_DENSE: 244,
    Profile.SUBMAP_LATTICE: 244,
    Profile.SUBMAP_LATTICE_SMALL: 50,
}
FEW_CELLS = ReconstructionSettings(max_cells=10_000)
SMALL = ReassemblySettings(slots=3, remembered=4, queued_events=16)


def decoded(frame: bytes) -> Packet | None:
    try:
        return decode(frame)
    except RemoteProtocolError as error:
        refusal = error
    assert refusal.cause in {"size", "crc", "version", "profile", "layout"}
    assert str(refusal)
    return None


def frame(data: bytes) -> None:
    """Decode as it is, and with a sound CRC, behind which the layout is reached."""
    padded = data[:252].ljust(252, b"\x00")
    for candidate in (data, with_crc(data), with_crc(padded), with_crc(padded[:18])):
        packet = decoded(candidate)
        assert packet is None or encode(packet) == candidate


def seal(data: bytes) -> None:
    """Nothing without the key is accepted, and nothing twice."""
    packet = decoded(with_crc(data))
    for receiver in (0, 2):
        opener, accepted = Opener(receiver, KEYS), 0
        for _ in range(2):
            with suppress(RemoteProtocolError):
                if packet is not None:
                    opener.open(packet)
                    accepted += 1
        assert accepted == 0 or (accepted == 1 and data in GENUINE)


def line(data: bytes) -> None:
    """All at once and in pieces give the same frames; a frame after it is read."""
    whole, pieces = LineReader(), LineReader()
    whole.receive_data(data)
    step = 1 + (data[0] if data else 0)
    for start in range(0, len(data), step):
        pieces.receive_data(data[start : start + step])
        assert len(pieces._partial) <= GUARD_BYTES
        assert len(pieces._ready) <= QUEUED_FRAMES
    assert list(whole._ready) == list(pieces._ready)
    whole.receive_data(wrap(b"after"))
    assert whole._ready[-1].frame == b"after"


def reassembly(data: bytes) -> None:
    """Any sequence of fragments: nothing handed on twice, nothing lost, memory bounded."""
    reassembler = Reassembler(SMALL)
    now_s, accepted, handed_on = 0.0, 0, 0
    for start in range(0, len(data) - 5, 6):
        a, b, c, d, e, g = data[start : start + 6]
        now_s += g / 4.0
        count = 1 + e % 15
        header = Header(
            profile=Profile.SUBMAP_LATTICE_SMALL,
            vehicle=a % 3,
            boot_epoch=a >> 6,
            submap=(b & 3) - 2 & 0xFFFF,
            fragment=d % count,
            fragment_count=count,
            tx_second=0,
            time_quarters=(c << 12) & 0xFFFFF,
        )
        reassembler.receive(SubmapFragment(header=header, body=bytes(50)), now_s)
        reassembler.missing(a % 3, a >> 6)
        assert len(reassembler._slots) <= SMALL.slots
        assert len(reassembler._closed) <= SMALL.remembered
        while (event := reassembler.next_event()) is not None:
            if isinstance(event, FragmentArrived):
                accepted += 1
            else:
                handed_on += len(event.fragments)
    reassembler.flush()
    while (event := reassembler.next_event()) is not None:
        if not isinstance(event, FragmentArrived):
            handed_on += len(event.fragments)
    assert reassembler.counters.events_dropped == 0
    assert handed_on == accepted == reassembler.counters.accepted


def submap(data: bytes) -> None:
    """Any bytes as the body of a sub-map's only frame: a bounded grid, or one error."""
    for profile, size in BODIES.items():
        header = Header(
            profile=profile,
            vehicle=1,
            boot_epoch=0,
            submap=0,
            fragment=0,
            fragment_count=1,
            tx_second=0,
            time_quarters=0,
        )
        fragment = SubmapFragment(header=header, body=data[:size].ljust(size, b"\x00"))
        try:
            grid = reconstruct_packets({0: fragment}, FEW_CELLS, 0.0).grid
        except EstimationError:
            continue
        assert grid.depth_m.size <= FEW_CELLS.max_cells
        assert not np.isinf(grid.depth_m).any()


def nmea(data: bytes) -> None:
    """Any bytes through the Micro-Modem's line parser, whole and byte by byte alike."""
    whole, pieces = SentenceReader(), SentenceReader()
    whole.receive_data(data)
    for byte in data:
        pieces.receive_data(bytes([byte]))
    while (sentence := whole.next_sentence()) is not None:
        assert sentence == pieces.next_sentence()


def micromodem(data: bytes) -> None:
    """Any bytes through the whole Micro-Modem dialect, with a frame to send."""
    modem = MicroModem(MicroModemSettings())
    now_s = 0.0
    for start in range(0, len(data), 40):
        modem.receive_data(data[start : start + 40], now_s)
        modem.poll(now_s)
        if start == 40:
            modem.send(bytes(range(256)), now_s)
        while modem.next_event() is not None:
            pass
        now_s += 0.7
    modem.status()


def nanomodem(data: bytes) -> None:
    """Any bytes through the Nanomodem's reply parser and dialect."""
    reader = ReplyReader()
    reader.receive_data(data, 0.0)
    while reader.next_reply() is not None:
        pass
    modem = Nanomodem(NanomodemSettings())
    now_s = 0.0
    for start in range(0, len(data), 20):
        modem.receive_data(data[start : start + 20], now_s)
        modem.poll(now_s)
        if start == 20:
            modem.send(bytes(range(60)), now_s)
        while modem.next_event() is not None:
            pass
        now_s += 0.7
    modem.status()


TARGETS: dict[str, Callable[[bytes], None]] = {
    "frame": frame,
    "seal": seal,
    "line": line,
    "reassembly": reassembly,
    "submap": submap,
    "nmea": nmea,
    "micromodem": micromodem,
    "nanomodem": nanomodem,
}
