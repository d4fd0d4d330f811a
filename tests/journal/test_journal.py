import sqlite3
from collections import Counter
from concurrent.futures import Future
from pathlib import Path

import numpy as np
import pytest

from firmware.journal import REPLAYS_TRIED, Journal, JournalSettings, Owner
from firmware.leader.atlas import Atlas
from firmware.store_file import StoreUnusableError
from protocol.errors import ConfigError
from tests.leader.vessels import sailed

OWNER = Owner(vehicle=1, fingerprint="this mission")
INPUTS = [(1, b"one"), (2, b""), (3, bytes(range(256)))]


NOISE = [np.random.default_rng(n).bytes(20_000) for n in range(3)]


def opened(folder: Path, owner: Owner = OWNER, waiting_bytes: int = 4_000_000) -> Journal:
    journal = Journal(folder, owner, JournalSettings(waiting_bytes=waiting_bytes))
    journal.start("here")
    return journal


def filled(folder: Path) -> Path:
    """Leave a store of three commits, as a dead process does: with its log beside it."""
    journal = opened(folder)
    for kind, body in INPUTS:
        journal.append(kind, body)
        journal.commit()
    path = folder / "follower_1.sqlite"
    images = {p: p.read_bytes() for p in folder.glob("follower_1.sqlite*")}
    journal.close()
    for image_path, image in images.items():
        image_path.write_bytes(image)
    return path


def test_what_is_committed_comes_back_in_order_and_the_rest_does_not(tmp_path: Path) -> None:
    filled(tmp_path)
    journal = opened(tmp_path)
    journal.append(9, b"never committed")
    assert journal.is_resumed
    assert list(journal.replay()) == INPUTS
    assert journal.boot_epoch == 0
    assert journal.counters["store_set_aside"] == 0


def test_checkpoint_takes_the_place_of_what_led_to_it(tmp_path: Path) -> None:
    journal = opened(tmp_path)
    journal.append(1, b"before")
    journal.checkpoint(b"the core")
    journal.append(2, b"after")
    journal.close()
    journal = opened(tmp_path)
    assert journal.checkpointed() == b"the core"
    assert list(journal.replay()) == [(2, b"after")]


@pytest.mark.parametrize("trouble", [MemoryError, RuntimeError("can't start new thread")])
def test_checkpoint_that_cannot_be_made_leaves_the_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, trouble: Exception
) -> None:
    def refused(*_: object) -> Future[bytes]:
        if isinstance(trouble, RuntimeError):
            raise trouble
        failed: Future[bytes] = Future()
        failed.set_exception(trouble)
        return failed

    journal = opened(tmp_path)
    monkeypatch.setattr(journal, "_compressed", refused)
    journal.append(1, b"before")
    journal.checkpoint(b"the core")
    journal.append(2, b"after")
    journal.close()
    assert journal.counters["store_checkpoints_put_off"] == 1
    journal = opened(tmp_path)
    assert journal.checkpointed() is None
    assert list(journal.replay()) == [(1, b"before"), (2, b"after")]


def test_start_is_that_of_the_first_life(tmp_path: Path) -> None:
    opened(tmp_path).close()
    journal = Journal(tmp_path, OWNER, JournalSettings())
    assert journal.start("elsewhere") == "here"


@pytest.mark.parametrize("cut", [0, 1, 31, 33, 4000, 9000])
def test_torn_log_gives_an_earlier_commit_whole(tmp_path: Path, cut: int) -> None:
    path = filled(tmp_path)
    log = path.with_name(path.name + "-wal")
    log.write_bytes(log.read_bytes()[: -cut or None])
    journal = opened(tmp_path)
    kept = list(journal.replay())
    assert kept == INPUTS[: len(kept)]
    assert len(kept) == 3 or cut


DAMAGES = {
    "row": "UPDATE inputs SET body = zeroblob(40) WHERE number = 2",
    "gap": "DELETE FROM inputs WHERE number = 2",
    "schema": "UPDATE about SET value = '0' WHERE name = 'schema'",
    "vehicle": "UPDATE about SET name = 'wehicle' WHERE name = 'vehicle'",
    "epoch": "UPDATE about SET value = '7' WHERE name = 'epoch'",
    "start": "DELETE FROM about WHERE name = 'start'",
}


@pytest.mark.parametrize("damage", ["noise", "empty", "half", "text", *DAMAGES])
def test_damaged_store_is_set_aside_and_the_next_epoch_begins(
    tmp_path: Path, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = filled(tmp_path)
    opened(tmp_path).close()
    damage_file(path, damage)
    before = path.read_bytes()
    journal = opened(tmp_path)
    assert not journal.is_resumed
    assert list(journal.replay()) == []
    assert journal.boot_epoch == 1
    assert journal.counters["store_set_aside"] == 1
    if damage != "empty":  # which SQLite takes for a new file
        assert (tmp_path / "follower_1.aside-1.sqlite").read_bytes() == before
    assert [record.message.count("\n") for record in caplog.records] == [0]
    journal.append(1, b"goes on")
    journal.close()
    assert list(opened(tmp_path).replay()) == [(1, b"goes on")]


def damage_file(path: Path, damage: str) -> None:
    data = path.read_bytes()
    match damage:
        case "noise":
            path.write_bytes(bytes((k * 97) % 256 for k in range(len(data))))
        case "empty":
            path.write_bytes(b"")
        case "half":
            path.write_bytes(data[: len(data) // 2])
        case "text":
            path.write_bytes(b"this is no database\n")
        case _:
            with sqlite3.connect(path) as database:
                database.execute(DAMAGES[damage])
            database.close()


def test_a_flipped_bit_raises_nothing_and_gives_nothing_that_was_not_put_in(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    journal, sheets = opened(tmp_path), {"one": b"sheet" * 40, "two": b"another" * 30}
    for name, body in sheets.items():
        journal.put(name, body)
    journal.append(1, b"before")
    journal.checkpoint(b"the core")
    journal.close()
    path, rng, fates = filled(tmp_path), np.random.default_rng(0), Counter[str]()
    opened(tmp_path).close()
    image = path.read_bytes()
    used = np.flatnonzero(np.frombuffer(image, dtype=np.uint8))
    for at in rng.choice(used, 80, replace=False):
        damaged = bytearray(image)
        damaged[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        journal = opened(tmp_path)
        if not journal.counters["store_set_aside"]:
            assert journal.is_resumed
            assert journal.checkpointed() == b"the core"
            assert list(journal.replay()) == INPUTS
            lost = [name for name, body in sheets.items() if journal.get(name) != body]
            assert journal.counters["store_shelf_unread"] == len(lost)
            fates["shelf"] += bool(lost)
        fates["aside"] += journal.counters["store_set_aside"]
        journal.close()
    assert fates["aside"] > 20
    assert fates["shelf"] > 5
    assert len(caplog.records) == fates["aside"]
    assert not any("\n" in record.message for record in caplog.records)


def test_what_the_shelf_has_lost_is_counted_and_the_map_goes_on(tmp_path: Path) -> None:
    journal = opened(tmp_path)
    atlas = Atlas(10, journal)
    for sheet in sailed(100.0).atlas:
        atlas.add(sheet)
    ids = [sheet.id for sheet in atlas]
    for sheet_id in ids[:3]:
        atlas.shelve(sheet_id)
    database = journal._file._database
    database.execute("UPDATE shelf SET body = zeroblob(99) WHERE name = '0/0/0'")
    assert len(list(atlas.grids())) == len(ids) - 1
    database.execute("DROP TABLE shelf")
    assert len(list(atlas.grids())) == len(ids) - 3
    assert journal.counters["store_shelf_unread"] == 1 + 3


@pytest.mark.parametrize("at", ["checkpoint", "inputs"])
def test_store_that_can_no_longer_be_read_cannot_be_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: str
) -> None:
    filled(tmp_path)
    journal = opened(tmp_path)

    def fails() -> bytes:
        raise sqlite3.OperationalError("disk I/O error")

    monkeypatch.setattr(journal._file, at, fails)
    with pytest.raises(StoreUnusableError, match="disk I/O"):
        _ = journal.checkpointed(), list(journal.replay())


def test_other_configuration_starts_anew_and_keeps_the_old_store(tmp_path: Path) -> None:
    filled(tmp_path)
    journal = opened(tmp_path, Owner(vehicle=1, fingerprint="another mission"))
    assert (journal.is_resumed, journal.boot_epoch) == (False, 1)
    assert (tmp_path / "follower_1.aside-1.sqlite").exists()


def test_store_whose_replay_is_deadly_is_set_aside(tmp_path: Path) -> None:
    filled(tmp_path)
    for _ in range(REPLAYS_TRIED):
        journal = opened(tmp_path)
        next(journal.replay())
        journal.close()
    assert opened(tmp_path).boot_epoch == 1


def test_store_of_another_vehicle_is_refused_by_name(tmp_path: Path) -> None:
    opened(tmp_path).close()
    (tmp_path / "follower_1.sqlite").rename(tmp_path / "follower_2.sqlite")
    with pytest.raises(ConfigError, match=r"store of vehicle 1, not of 2"):
        opened(tmp_path, Owner(vehicle=2, fingerprint="this mission"))


def test_store_in_use_is_refused(tmp_path: Path) -> None:
    journal = opened(tmp_path)
    with pytest.raises(ConfigError, match="in use by another process"):
        opened(tmp_path)
    journal.close()


def test_lost_store_still_means_the_next_epoch(tmp_path: Path) -> None:
    filled(tmp_path).unlink()
    (tmp_path / "follower_1.sqlite-wal").unlink()
    assert opened(tmp_path).boot_epoch == 1


def test_unreadable_epoch_is_counted(tmp_path: Path) -> None:
    (tmp_path / "follower_1.epoch").write_text("x")
    assert opened(tmp_path).counters["store_epoch_unreadable"] == 1


def test_folder_that_cannot_be_written_leaves_the_mission_in_memory(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("")
    journal = opened(tmp_path / "file")
    journal.append(1, b"x")
    journal.commit()
    assert journal.counters["store_lost"] == 1
    assert "the mission goes on in memory" in caplog.text


def test_lives_that_no_disk_counts_are_told_apart_by_the_clock(tmp_path: Path) -> None:
    counted = opened(tmp_path)
    counted.close()
    (tmp_path / "follower_1.sqlite").unlink()
    (tmp_path / "follower_1.sqlite").mkdir()  # can neither be opened nor be made
    settings = JournalSettings()
    begins_s = (0.0, 99.0, 139.0, 430.0, 470.0)
    lives = [Journal(tmp_path, OWNER, settings, began_s) for began_s in begins_s]
    assert all(life.counters["store_lost"] for life in lives)
    epochs = [life.boot_epoch for life in lives]
    assert len(set(epochs)) == len(epochs)
    assert not set(epochs) & {counted.boot_epoch, counted.boot_epoch + 1}


def full(journal: Journal, pages: int) -> None:
    """Let the disk have as many pages as the store has now, or some more."""
    database = journal._file._connection
    assert database is not None
    now = database.execute("PRAGMA page_count").fetchone()[0]
    database.execute(f"PRAGMA max_page_count = {now + pages}")


def test_full_disk_is_counted_and_healed_without_a_gap(tmp_path: Path) -> None:
    journal = opened(tmp_path)
    full(journal, 0)
    for body in NOISE:
        journal.append(1, body)
        journal.commit()
    assert journal.counters["store_commits_failed"] > 0
    full(journal, 100)
    journal.append(2, b"room again")
    journal.close()
    assert list(opened(tmp_path).replay()) == [*((1, body) for body in NOISE), (2, b"room again")]


def test_full_and_lost_stores_say_that_they_put_nothing_away(tmp_path: Path) -> None:
    journal = opened(tmp_path, waiting_bytes=1000)
    assert journal.put("kept", b"body")
    full(journal, 0)
    assert not journal.put("too large", NOISE[0])
    for body in NOISE:
        journal.append(1, body)
        journal.commit()
    assert journal.counters["store_lost"] == 1
    assert not journal.put("too late", b"body")
    assert journal.counters["store_shelf_refused"] == 2


def test_disk_that_stays_full_ends_the_store_in_bounded_memory(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    journal = opened(tmp_path, waiting_bytes=1000)
    full(journal, 0)
    for body in NOISE:
        journal.append(1, body)
        journal.commit()
    assert journal.counters["store_lost"] == 1
    assert caplog.text.count("goes on in memory") == 1
