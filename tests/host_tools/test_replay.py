import os
import time
from pathlib import Path

import numpy as np
import pytest

from host_tools.cli import main
from host_tools.replay.gsf import _pings, ping_s, read_gsf, true_north_rad, utm_of


def logs() -> Path:
    pytest.importorskip("GSFU", reason="gsfu is not installed")
    folder = os.environ.get("FATHOMLINK_DATA")
    if not folder:
        pytest.skip("FATHOMLINK_DATA is not set")
    return Path(folder) / "logs"


def test_utm_zone_follows_longitude_and_hemisphere() -> None:
    assert utm_of(-64.6, 17.8) == "EPSG:32620"
    assert utm_of(3.2, -42.0) == "EPSG:32731"
    assert utm_of(180.0, 1.0) == "EPSG:32660"


@pytest.mark.parametrize(("longitude_deg", "latitude_deg"), [(-64.6, 17.8), (-61.0, -40.0)])
def test_true_north_is_turned_by_the_convergence_of_meridians(
    longitude_deg: float, latitude_deg: float
) -> None:
    crs = utm_of(longitude_deg, latitude_deg)
    aside_rad = np.radians(longitude_deg + 63.0)  # of the zone's meridian
    turned = np.tan(aside_rad) * np.sin(np.radians(latitude_deg))
    bearings_rad = true_north_rad(crs, [longitude_deg], [latitude_deg])
    np.testing.assert_allclose(np.degrees(bearings_rad), -np.degrees(np.arctan(turned)), atol=1e-3)


def test_times_of_pings_are_utc(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TZ", "Europe/Berlin")  # where 02:59:59 came twice that night
    time.tzset()
    try:
        seconds = [ping_s({"PingTime": f"2023-10-29 {at}"}) for at in ("02:59:59", "03:00:00.5")]
    finally:
        monkeypatch.undo()
        time.tzset()
    assert seconds[1] - seconds[0] == 1.5


def test_gsf_line_lies_where_and_as_deep_as_it_was_surveyed() -> None:
    line = read_gsf(logs() / "em302_line_0059.gsf")
    assert line.track_time_s.size == 50
    assert line.track_time_s[-1] == pytest.approx(298, abs=2)
    assert line.depth_m.size + line.rejected == 50 * 432
    assert 1100 < line.depth_m.min() < line.depth_m.max() < 2400
    length_m = np.hypot(np.diff(line.track_north_m), np.diff(line.track_east_m)).sum()
    assert length_m == pytest.approx(1250, rel=0.05)
    assert line.crs == "EPSG:32620"
    headings_deg = [ping["Heading_deg"] for ping in _pings(logs() / "em302_line_0059.gsf")]
    turned_deg = np.degrees(line.track_yaw_rad) - headings_deg
    np.testing.assert_allclose(turned_deg, 0.488, atol=0.01)  # 1.6 degrees west of the meridian
    course = np.arctan2(line.track_east_m[-1], line.track_north_m[-1])
    assert np.degrees(np.abs(course - np.median(line.track_yaw_rad))) < 15


def test_two_sides_of_the_swath_are_seen_alike_from_neighbouring_pings() -> None:
    line = read_gsf(logs() / "em302_line_0059.gsf")
    cell = np.round(np.stack([line.north_m, line.east_m]) / 100).astype(int)
    _, which = np.unique(cell, axis=1, return_inverse=True)
    count = np.bincount(which)
    mean_m = np.bincount(which, line.depth_m) / count
    spread_m = np.sqrt(np.bincount(which, (line.depth_m - mean_m[which]) ** 2) / count)
    assert np.median(spread_m[count > 5]) < 40  # of 1,166 to 2,317 m, on slopes


def test_replay_writes_what_compress_reads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "line.npz"
    log = logs() / "em302_line_0059.gsf"
    assert main(["replay", str(log), "--out", str(out)]) == 0
    assert "50 pings" in capsys.readouterr().out
    with np.load(out) as arrays:
        assert {"north_m", "east_m", "depth_m", "time_s", "track_yaw_rad"} <= set(arrays)


@pytest.mark.parametrize("content", [None, b"", b"not a log at all" * 10])
def test_what_is_no_log_is_one_line_and_status_2(
    content: bytes | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("GSFU", reason="gsfu is not installed")
    path = tmp_path / "line.gsf"
    if content is not None:
        path.write_bytes(content)
    assert main(["replay", str(path), "--out", str(tmp_path / "out.npz")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
