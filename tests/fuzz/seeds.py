"""Seeds of the corpus: python -m tests.fuzz.seeds writes those that are not there."""

import hashlib
from pathlib import Path

from firmware.compression import compress, packets_from
from firmware.compression.packing import submap_header
from firmware.compression.settings import CompressionSettings
from protocol import vectors
from protocol.codec import encode
from protocol.packets import SubmapFragment
from tests.compression.conftest import made_survey

CORPUS = Path(__file__).parent / "corpus"
SENTENCES = (
    b"$CAREV,030303,AUV,2.0.27087*16\r\n$CACFG,SRC,1*33\r\n$CACYC,0,1,2,4,0,1*5D\r\n",
    b"$CACST,1,153026.0000,0,4105,30,0318,0193,10,00,00,01,01,2,004,004,3,3,3,1,154,09,08,10,-6"
    b",000,0.0,4125000,5000*5B\r\n",
    b"$CARXD,1,2,0,1,000102*61\r\n$CAMPR,1,2,0.6667*7D\r\n$CADRQ,120000,1,2,0,256,1*75\r\n",
    b"$CAREV,191605,AUV,3.9.4*19\r\n$CATMQ,2019-12-02T03:02:59Z,RTC,RTC*6E\r\n$CAERR,1,NMEA,3,x\r\n",
)
REPLIES = (
    b"#A002V26000\r\n$B60\r\n#R002T01234\r\n",
    b"#B00104abcd\r\n#U04ab$#\r\nE\r\n#TO\r\n$C0\r\n$C-\r\n",
)


def seeds() -> dict[str, list[bytes]]:
    """Return the seeds by target."""
    frames = [encode(packet) for packet in vectors.packets().values()]
    sealed = [frame for frame, _ in vectors.sealed().values()]
    rejects = [data for data, _ in vectors.rejects().values()]
    lines = [data for data, _ in vectors.line().values()]
    return {
        "frame": [*frames, *sealed, *rejects, *(frame[:-4] for frame in frames)],
        "seal": [frame[:-4] for frame in sealed],
        "line": lines,
        "reassembly": [bytes(range(0, 240)), bytes(600), b"\x01\x02\x03\x04\x09\x10" * 30],
        "submap": bodies(),
        "nmea": [*SENTENCES, b"".join(SENTENCES)],
        "micromodem": [*SENTENCES, b"".join(SENTENCES)],
        "nanomodem": [*REPLIES, b"".join(REPLIES)],
    }


def bodies() -> list[bytes]:
    """Return what a sub-map's only frame carries, by profile."""
    survey = made_survey()
    packets = [
        packets_from(
            compress(survey.bins, CompressionSettings(frames=1, small_frames=small), profile),
            survey.track,
            submap_header(),
        )[0]
        for profile, small in (("dense", False), ("lattice", False), ("lattice", True))
    ]
    return [packet.body for packet in packets if isinstance(packet, SubmapFragment)]


def main() -> None:
    """Write each seed under a name made from its content."""
    for target, inputs in seeds().items():
        folder = CORPUS / target
        folder.mkdir(parents=True, exist_ok=True)
        for data in inputs:
            (folder / hashlib.sha256(data).hexdigest()[:16]).write_bytes(data)


if __name__ == "__main__":
    main()
