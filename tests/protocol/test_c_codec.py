"""The C99 codec compiles without a warning and agrees with this one, byte for byte."""

import json
import shutil
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest

from protocol import c_header, vectors
from protocol.codec import decode, encode
from protocol.crc import with_crc
from protocol.errors import RemoteProtocolError
from protocol.framing import wrap
from protocol.packets import BODY_BYTES, SIZE_BYTES, Profile

ROOT = Path(__file__).parents[2]
RESULTS = ["ok", "size", "crc", "version", "profile", "layout"]
FLAGS = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror"]
SANITIZE = ["-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]


def test_the_header_is_what_the_command_makes() -> None:
    path = c_header.FOLDER / "fathomlink_wire.h"
    assert path.read_text() == c_header.header(), "run: python -m protocol.c_header"


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        pytest.skip("needs a C compiler: apt install gcc")
    path = tmp_path_factory.mktemp("c") / "wire_check"
    source = c_header.FOLDER / "wire_check.c"
    subprocess.run([compiler, *FLAGS, *SANITIZE, str(source), "-o", str(path)], check=True)
    return path


def run(program: Path, frames: list[bytes]) -> list[tuple[str, bytes | None, bytes]]:
    """Return (result, frame encoded again, line) of each frame, as the C codec sees it."""
    records = b"".join(struct.pack("<H", len(frame)) + frame for frame in frames)
    done = subprocess.run([str(program)], input=records, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
    found, output, at = [], done.stdout, 0

    def record() -> bytes:
        nonlocal at
        (size,) = struct.unpack_from("<H", output, at)
        at += 2 + size
        return output[at - size : at]

    while at < len(output):
        result = RESULTS[output[at]]
        at += 1
        again = record() if result == "ok" else None
        found.append((result, again, record()))
    return found


def in_python(frame: bytes) -> tuple[str, bytes | None, bytes]:
    try:
        return "ok", encode(decode(frame)), wrap(frame)
    except RemoteProtocolError as error:
        return error.cause, None, wrap(frame)


def random_frames(count: int, seed: int) -> list[bytes]:
    """Return frames of every profile with random content, some of them damaged."""
    rng = np.random.default_rng(seed)
    profiles = list(Profile)
    frames = []
    for _ in range(count):
        profile = profiles[int(rng.integers(len(profiles)))]
        body = bytearray(rng.bytes(SIZE_BYTES[profile] - 4))
        body[0] = 1 << 5 | profile
        spare = BODY_BYTES[profile] % 12
        if profile.plain in {Profile.TRAJECTORY, Profile.TRAJECTORY_SMALL} and rng.random() < 0.9:
            body[8 + BODY_BYTES[profile] - spare : 8 + BODY_BYTES[profile]] = bytes(spare)
        kind = rng.random()
        if kind < 0.05:
            body[0] ^= int(rng.integers(1, 256))
        elif kind < 0.1:
            body = body[: int(rng.integers(1, len(body)))]
        frame = with_crc(bytes(body))
        frames.append(frame[:-1] + b"\x00" if kind > 0.95 else frame)
    return frames


def test_vectors_and_rejects_come_out_alike(program: Path) -> None:
    document = vectors.frames_document()
    assert isinstance(document["accepted"], list)
    assert isinstance(document["rejected"], list)
    known = [*document["accepted"], *document["rejected"]]
    frames = [bytes.fromhex(vector["hex"]) for vector in known]
    frames += [frame for frame, _ in vectors.sealed().values()]
    assert run(program, frames) == [in_python(frame) for frame in frames]


def test_fields_are_found_under_their_names(program: Path) -> None:
    path = ROOT / "tests" / "vectors" / "frames.json"
    for vector in json.loads(path.read_text())["accepted"]:
        done = subprocess.run(
            [str(program), "fields"],
            input=vector["hex"],
            capture_output=True,
            text=True,
            check=True,
        )
        found: dict[str, list[float]] = {}
        for text in done.stdout.splitlines():
            name, value = text.split()
            found.setdefault(name, []).append(float(value))
        for name, values in found.items():
            expected = np.atleast_1d(np.array(vector["fields"][name], dtype=float))
            if name == "submap":  # in answers it stands in the header too
                expected = np.full(len(values), expected[0])
            np.testing.assert_allclose(np.array(values), expected, rtol=1e-7)


def test_random_packets_come_out_alike(program: Path) -> None:
    frames = random_frames(5000, seed=1)
    results = run(program, frames)
    assert results == [in_python(frame) for frame in frames]
    assert {result for result, _, _ in results} == set(RESULTS)


@pytest.mark.slow
def test_a_million_random_packets_come_out_alike(program: Path) -> None:
    for seed in range(100):
        frames = random_frames(10_000, seed)
        assert run(program, frames) == [in_python(frame) for frame in frames]
