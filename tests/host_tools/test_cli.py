import argparse
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from host_tools.cli import main
from host_tools.command_line import build_parser
from host_tools.commands import parse_changes, status_of
from host_tools.mission_settings import MissionSettings, changed
from protocol.codec import encode
from protocol.packets import Answer, Header, Profile, SubmapPacket

PROFILE = "leader.ranges.sound_profile.points"


def frames() -> list[bytes]:
    answer = Answer(
        header=Header(
            profile=Profile.ANSWER,
            vehicle=0,
            boot_epoch=0,
            submap=3,
            fragment=1,
            fragment_count=4,
            tx_second=3,
            time_quarters=480,
        ),
        submap=2,
        north_m=120.5,
        east_m=-4.0,
    )
    fragment = SubmapPacket(
        header=Header(
            profile=Profile.SUBMAP_PAPER,
            vehicle=1,
            boot_epoch=0,
            submap=12,
            fragment=7,
            fragment_count=10,
            tx_second=8,
            time_quarters=1920,
        ),
        trajectory=np.zeros((4, 3), dtype=np.float32),
        points_ned_m=np.full((15, 3), 40.0, dtype=np.float32),
        hyperparameters=np.array([0.1, 1.0, 0.02, 40.0], dtype=np.float32),
    )
    return [encode(answer), encode(fragment)]


INTERRUPTED = """
import os, signal, sys
from host_tools.cli import main

class Interrupts:
    def find_spec(self, name, *_):
        if name == "host_tools.simulate":
            os.kill(os.getpid(), signal.SIGINT)

signal.signal(signal.SIGINT, signal.default_int_handler)  # what runs in the background ignores it
sys.meta_path.insert(0, Interrupts())
sys.exit(main(["config", "show"]))
"""


def test_a_command_interrupted_while_it_is_imported_says_so_in_one_line() -> None:
    done = subprocess.run([sys.executable, "-c", INTERRUPTED], capture_output=True, check=False)
    assert (done.returncode, done.stdout) == (2, b"")
    assert done.stderr == b"fathomlink: interrupted\n"


def test_a_closed_stream_is_the_null_device_and_no_file_of_a_mission(tmp_path: Path) -> None:
    taken = tmp_path / "taken"
    program = (
        "import os, sys; os.close(1); sys.stdout = None; from host_tools.cli import main; "
        f"status = main(['config', 'show']); stream = open({str(taken)!r}, 'w'); "
        "os.write(1, b'from a library'); sys.exit(status)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert taken.read_bytes() == b""


def test_config_show_lists_settings_with_units_and_reasons(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["config", "show", "--scenario", "paper-2", "--set", "leg_m=450"]) == 0
    lines = capsys.readouterr().out.splitlines()
    shown = {line.split(" = ")[0]: line for line in lines}
    assert shown["scenario.leg_m"].startswith("scenario.leg_m = 450 m ")
    assert shown["scenario.duration_min"].startswith("scenario.duration_min = 55 min")
    assert "scenario.water.outlier_share" in shown
    assert all("#" in line for line in lines)


@pytest.mark.parametrize(
    "change", ["duration_min=5", "leg_m=300", "outlier_share=0.8", "followers=2", "loss=0.3"]
)
def test_short_keys_of_the_contract_are_not_ambiguous(
    change: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["config", "show", "--set", change]) == 0
    captured = capsys.readouterr()
    key, value = change.split("=")
    assert f"{key} = {value}" in captured.out
    assert captured.err == ""


@pytest.mark.parametrize(
    ("given", "shown"), [("0,1500,50.5,1480", "0,1500,50.5,1480"), ("", "none"), ("none", "none")]
)
def test_sound_profile_is_shown_as_it_is_set(
    given: str, shown: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["config", "show", "--set", f"{PROFILE}={given}"]) == 0
    assert f"{PROFILE} = {shown} m,m/s" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--scenario", "paper-9"], "choose one of paper-1, paper-2, field-1, day-1"),
        (["--set", "depth_of_field=3"], "unknown setting 'depth_of_field'"),
        (["--set", "duratoin_min=3"], "did you mean scenario.duration_min?"),
        (["--set", "leg_m"], "is not KEY=VALUE"),
        (["--set", "leg_m=long"], "give a number"),
        (["--loss", "1.5"], "must be at most 1"),
        (
            ["--set", "slots.followers=3"],
            "slots have 3 followers, the scenario has 1; give followers=3",
        ),
        (["--set", "followers=2", "--set", "slots.followers=1"], "give followers=1"),
        (["--loss", "14"], "loss is 14.0 as a share; it must be at most 1.0"),
        (["--set", "line_spacing_m=inf"], "line_spacing_m is inf; give a finite number in m"),
        (["--set", "corner_offset_m=-inf"], "corner_offset_m is -inf; give a finite number"),
        (["--set", "line_spacing_m=nan"], "line_spacing_m is nan; give a finite number in m"),
        (["--set", "leader.atlas_submaps=inf"], "give a whole number"),
        (["--set", f"{PROFILE}=0,1500,50"], "give pairs of depth in m and speed in m/s"),
        (["--set", f"{PROFILE}=0,1500,50,fast"], "give a number"),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["config", "show", *arguments]) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""


@pytest.mark.parametrize(
    "arguments",
    [
        ["swim"],
        ["inspect"],
        ["config", "show", "--loss", "much"],
        ["emulate", "nanomodem", "--seed", "-1"],
        [],
    ],
)
def test_unreadable_arguments_are_one_line_and_status_2(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("command", [["simulate", "--out", "x"], ["config", "show"]])
def test_an_unknown_argument_points_to_the_help_of_its_subcommand(
    command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main([*command, "--seeds", "3"])
    of = " ".join(part for part in command if part not in {"--out", "x"})
    assert f"unrecognized arguments: --seeds 3 (try fathomlink {of} --help)" in (
        capsys.readouterr().err
    )


@pytest.mark.parametrize(
    "command", ["simulate", "demo", "channel", "follower", "leader", "reproduce"]
)
def test_a_folder_without_a_name_is_not_the_current_one(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        main([command, "--out", "", "--seed"])  # which has no value, so that nothing begins
    assert stopped.value.code == 2
    assert "argument --out: the name is empty; give a folder" in capsys.readouterr().err


def test_inspect_describes_frames_and_steps_over_garbage(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    answer, fragment = frames()
    path = tmp_path / "frames.bin"
    path.write_bytes(answer + b"\x21garbage" + fragment + fragment[:100])
    assert main(["inspect", str(path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4
    assert "to vehicle 1 epoch 4, submap 2: north 120.5 m, east -4.0 m" in lines[0]
    assert "fragment" not in lines[0]
    assert "submap 3" not in lines[0]  # that field of an answer holds a sigma and a count
    assert "8 bytes that are no frame" in lines[1]
    assert "submap 12 fragment 7/10" in lines[2]
    assert "15 points" in lines[2]
    assert "100 bytes that are no frame" in lines[3]


def test_inspect_of_a_file_without_frames_says_what_to_give(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("no frame is as short as this")
    assert main(["inspect", str(path)]) == 2
    assert "holds no whole frame; give frames back to back" in capsys.readouterr().err


def test_inspect_reads_air_and_says_why_a_frame_is_dropped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    answer, fragment = frames()
    damaged = fragment[:50] + b"\xff" + fragment[51:]
    path = tmp_path / "air.jsonl"
    path.write_text(
        "".join(
            json.dumps(
                {
                    "t_tx_s": 4.0,
                    "t_rx_s": None,
                    "source": 1,
                    "destination": 0,
                    "hex": frame.hex(),
                    "fate": "delivered",
                }
            )
            + "\n"
            for frame in (answer, damaged)
        )
    )
    assert main(["inspect", str(path)]) == 0
    first, second = capsys.readouterr().out.splitlines()
    assert "1 -> 0  delivered" in first
    assert "dropped" in second
    assert "CRC" in second


def test_inspect_of_the_air_of_one_vehicle_shows_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "air.jsonl"
    path.write_bytes(b"")
    assert main(["inspect", str(path)]) == 0
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("", "")


AIR = b'{"t_tx_s": 1.0, "t_rx_s": null, "source": %s, "destination": 0, "hex": "", "fate": ""}'


@pytest.mark.parametrize(
    "content",
    [None, b"", b'{"t_tx_s": 1}\n', b'{"a":' + b"[" * 100_000, AIR % b"Infinity", AIR % b"NaN"],
)
def test_inspect_refuses_what_is_no_file_of_frames(
    tmp_path: Path, content: bytes | None, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "file"
    if content is not None:
        path.write_bytes(content)
    assert main(["inspect", str(path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_an_error_of_the_system_without_a_file_is_one_line(
    capsys: pytest.CaptureFixture[str],
) -> None:
    def full() -> None:
        raise OSError("no space left")

    assert status_of("benchmarks.days", full) == 2
    assert capsys.readouterr().err == "benchmarks.days: no space left\n"


def arguments_of(parser: argparse.ArgumentParser) -> Iterator[tuple[str, argparse.Action]]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for below in action.choices.values():
                yield from arguments_of(below)
        else:
            yield parser.prog, action


def test_help_says_what_every_argument_is() -> None:
    arguments = list(arguments_of(build_parser()))
    assert len(arguments) > 50
    assert [(prog, action.dest) for prog, action in arguments if not action.help] == []


@pytest.mark.parametrize(
    "command",
    [
        ["replay", "one", "--out", "one"],
        ["compress", "one", "--out", "./one"],
        ["reconstruct", "one", "--out", "one"],
        ["inspect", "one", "--pcap", "one"],
    ],
)
def test_no_output_is_written_over_its_input(
    command: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("one").write_bytes(bytes(256))
    assert main(command) == 2
    assert "one would be written over its own input" in capsys.readouterr().err
    assert Path("one").read_bytes() == bytes(256)


def test_of_two_values_of_a_key_the_later_one_counts() -> None:
    changes = parse_changes(["leg_m=200", "scenario.leg_m=300", "leg_m=100"])
    assert changed(MissionSettings(), changes).scenario.leg_m == 100.0
