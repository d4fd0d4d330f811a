"""The golden vectors are the contract: this decoder, and the files, agree with them."""

import json
import re
import struct
from pathlib import Path
from typing import Any

import pytest

from protocol import vectors
from protocol.codec import decode, encode
from protocol.errors import RemoteProtocolError
from protocol.framing import LineReader
from protocol.layouts import BODIES, HEADER_FIELDS, fingerprint
from protocol.packets import BODY_BYTES, SIZE_BYTES, VERSION, Profile
from protocol.seal import Keys, Opener, receiver_of

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "tests" / "vectors"
WIRE = (ROOT / "protocol" / "WIRE.md").read_text()


def load(name: str) -> dict[str, Any]:
    document: dict[str, Any] = json.loads((FOLDER / f"{name}.json").read_text())
    return document


FRAMES, LINE, SEAL = load("frames"), load("line"), load("seal")


def ids(vector: dict[str, Any]) -> str:
    return str(vector["name"]).replace(" ", "-")


def test_files_are_what_the_command_writes(tmp_path: Path) -> None:
    vectors.main([str(tmp_path)])
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in FOLDER.iterdir()}
    for path in sorted(tmp_path.iterdir()):
        assert path.read_text() == (FOLDER / path.name).read_text(), (
            "the wire changed: raise VERSION, note it in CHANGELOG.md under Wire format, and run"
            " python -m protocol.vectors tests/vectors"
        )


@pytest.mark.parametrize("vector", FRAMES["accepted"], ids=ids)
def test_accepted_frames_decode_to_their_fields_and_encode_again(vector: dict[str, Any]) -> None:
    frame = bytes.fromhex(vector["hex"])
    packet = decode(frame)
    assert vectors.packet_fields(packet) == vector["fields"]
    assert encode(packet) == frame


@pytest.mark.parametrize("vector", FRAMES["rejected"], ids=ids)
def test_rejected_frames_raise_with_their_cause(vector: dict[str, Any]) -> None:
    with pytest.raises(RemoteProtocolError) as caught:
        decode(bytes.fromhex(vector["hex"]))
    assert caught.value.cause == vector["cause"]


@pytest.mark.parametrize("vector", LINE["vectors"], ids=ids)
def test_line_vectors_give_their_frames(vector: dict[str, Any]) -> None:
    reader = LineReader()
    reader.receive_data(bytes.fromhex(vector["hex"]))
    found = []
    while (line_frame := reader.next_frame()) is not None:
        found.append(line_frame.frame.hex())
    assert found[-len(vector["frames"]) :] == vector["frames"]


@pytest.mark.parametrize("vector", SEAL["accepted"], ids=ids)
def test_sealed_vectors_open_to_their_fields(vector: dict[str, Any]) -> None:
    packet = decode(bytes.fromhex(vector["hex"]))
    opener = Opener(receiver_of(packet.header), Keys(bytes.fromhex(SEAL["key"])))
    assert vectors.packet_fields(opener.open(packet)) == vector["opened"]


def test_every_plain_profile_has_a_vector() -> None:
    seen = {vector["fields"]["profile"] for vector in FRAMES["accepted"]}
    assert seen >= {int(profile) for profile in Profile if not profile.is_sealed}


def test_wire_md_names_the_fingerprint_of_this_version() -> None:
    assert f"| {VERSION} | `{fingerprint()}` |" in WIRE


@pytest.mark.parametrize("profile", list(Profile))
def test_wire_md_lists_every_profile_with_its_sizes(profile: Profile) -> None:
    sizes = f"{SIZE_BYTES[profile]} | {BODY_BYTES[profile]}"
    assert f"| {int(profile)} | `{profile.name}` | {sizes} |" in WIRE


def test_wire_md_tells_the_sizes_of_its_structures() -> None:
    told = re.findall(r"Struct (>\w+) \((\d+) bytes\)", WIRE)
    assert len(told) == 2
    assert [int(size) for _, size in told] == [struct.calcsize(layout) for layout, _ in told]


def test_wire_md_names_every_field() -> None:
    names = {name for name, _ in HEADER_FIELDS}
    names |= {name for table in BODIES.values() for name, _, _ in table}
    assert [name for name in sorted(names) if f"`{name}`" not in WIRE] == []
