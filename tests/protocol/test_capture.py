"""Captures that tshark reads with the dissector made from the layout table."""

import json
import shutil
import struct
import subprocess
from pathlib import Path

import pytest

from host_tools import dissector
from host_tools.inspector import inspect_file, write_capture
from protocol import vectors
from protocol.codec import encode
from protocol.errors import ConfigError

SCRIPT = dissector.FOLDER / "fathomlink.lua"


def test_the_dissector_is_ready_made_and_what_the_command_makes() -> None:
    """MAVLink's users had to make theirs: pymavlink issue 133."""
    assert SCRIPT.read_text() == dissector.script(), "run: python -m host_tools.dissector"


def frames() -> list[bytes]:
    return [encode(packet) for packet in vectors.packets().values()]


@pytest.fixture
def air(tmp_path: Path) -> Path:
    path = tmp_path / "air.jsonl"
    lines = []
    for i, frame in enumerate(frames()):
        record = {"t_tx_s": 4.0 * i, "t_rx_s": 4.0 * i + 0.5, "source": 1, "destination": 0}
        lines.append(json.dumps(record | {"hex": frame.hex(), "fate": "delivered"}))
    lost = {"t_tx_s": 90.0, "t_rx_s": None, "source": 1, "destination": 0, "fate": "lost"}
    lines.append(json.dumps(lost | {"hex": (frames()[0][:-1] + b"\x00").hex()}))
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_capture_of_the_air_has_every_frame_with_its_time(air: Path, tmp_path: Path) -> None:
    assert write_capture(air, tmp_path / "out.pcap") == len(frames()) + 1
    data = (tmp_path / "out.pcap").read_bytes()
    assert struct.unpack_from("<IHHiIII", data) == (0xA1B2C3D4, 2, 4, 0, 0, 65535, 148)
    seconds, micros, size, original = struct.unpack_from("<IIII", data, 24)
    assert (seconds, micros, size, original) == (0, 500_000, 259, 259)
    assert data[40:43] == bytes([1, 0, 0])
    assert data[43 : 43 + 256] == frames()[0]


def test_a_file_of_frames_is_split_and_what_is_no_frame_stays_visible(tmp_path: Path) -> None:
    path = tmp_path / "frames.bin"
    path.write_bytes(b"garbage" + b"".join(frames()[:2]) + b"more")
    lines = list(inspect_file(path))
    assert len(lines) == 4
    assert "7 bytes that are no frame" in lines[0]
    assert "submap paper" in lines[1]
    assert write_capture(path, tmp_path / "out.pcap") == 4


@pytest.mark.parametrize("time_s", ["NaN", "Infinity", "-5.0", "1e30"])
def test_a_time_that_is_none_is_named_with_its_line(air: Path, tmp_path: Path, time_s: str) -> None:
    air.write_text(air.read_text().replace("90.0", time_s))
    with pytest.raises(ConfigError, match=rf"line {len(frames()) + 1}: not a line of air.jsonl"):
        write_capture(air, tmp_path / "out.pcap")


def test_tshark_reads_every_field(air: Path, tmp_path: Path) -> None:
    if shutil.which("tshark") is None:
        pytest.skip("needs tshark: apt install tshark")
    capture = tmp_path / "out.pcap"
    write_capture(air, capture)
    columns = ["version", "profile", "vehicle", "boot_epoch", "submap", "fragment"]
    columns += ["fragment_count", "tx_second", "time_quarters"]
    arguments = [a for name in [*columns, "crc.good"] for a in ("-e", f"fathomlink.{name}")]
    done = subprocess.run(
        ["tshark", "-X", f"lua_script:{SCRIPT}", "-r", str(capture), "-T", "fields", *arguments],
        capture_output=True,
        text=True,
        check=True,
    )
    rows = [line.split("\t") for line in done.stdout.splitlines()]
    assert len(rows) == len(frames()) + 1
    for row, packet in zip(rows, vectors.packets().values(), strict=False):
        header = [int(getattr(packet.header, name)) for name in columns]
        assert [int(value) for value in row[:-1]] == header
        assert row[-1] in {"1", "True"}
    assert rows[-1][-1] in {"0", "False"}
