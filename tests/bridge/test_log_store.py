from __future__ import annotations

import os

import pytest

from bridge.log_store import create_log, find_logs, make_room, next_session, remove_log

UTC_US = 1_795_387_545_000_000  # 2026-11-22 22:45:45


def make(directory, session="", utc_us=0, size=0):
    path, file = create_log(directory, session, utc_us)
    os.write(file, bytes(size))
    os.close(file)
    return path


def test_names_are_px4s(tmp_path):
    assert next_session(tmp_path / "none") == "sess001"
    assert make(tmp_path, "sess001").relative_to(tmp_path).as_posix() == "sess001/log100.ulg"
    assert make(tmp_path, "sess001").name == "log101.ulg"
    assert next_session(tmp_path) == "sess002"
    dated = make(tmp_path, "sess001", UTC_US)
    assert dated.relative_to(tmp_path).as_posix() == "2026-11-22/22_45_45.ulg"
    assert make(tmp_path, "sess001", UTC_US).name == "22_45_45_1.ulg", "an existing log is never overwritten"


def test_time_of_day_comes_from_the_name(tmp_path):
    make(tmp_path, "sess001", UTC_US, size=5)
    (log,) = find_logs(tmp_path)
    assert (log.size, log.utc_s) == (5, UTC_US // 1_000_000)
    (tmp_path / "2026-02-31").mkdir()
    (tmp_path / "2026-02-31" / "99_99_99.ulg").touch()
    assert find_logs(tmp_path)[0].utc_s == 0


def test_oldest_first(tmp_path):
    paths = [make(tmp_path, f"sess{number:03d}") for number in (9, 10, 999, 1000)]
    paths += [make(tmp_path, "", UTC_US + second * 1_000_000) for second in (0, 1, 86_400)]
    assert [log.path for log in find_logs(tmp_path)] == paths
    assert [log.path for log in find_logs(tmp_path, most=2)] == paths[-2:]


def test_what_is_no_log_is_neither_seen_nor_removed(tmp_path):
    outside = tmp_path / "outside.ulg"
    outside.write_bytes(b"precious")
    logs = tmp_path / "logs"
    real = make(logs, "sess001")
    (real.parent / "notes.txt").touch()
    (real.parent / "link.ulg").symlink_to(outside)
    (logs / "sess002").symlink_to(tmp_path)
    (logs / "stray.ulg").touch()
    (logs / "other").mkdir()
    (logs / "other" / "a.ulg").touch()
    assert [log.path for log in find_logs(logs)] == [real]
    assert make_room(logs, most_bytes=-1, most_folders=0) == 1
    assert sorted(path.name for path in real.parent.iterdir()) == ["link.ulg", "notes.txt"]
    assert outside.read_bytes() == b"precious"


def test_an_empty_folder_goes_with_its_last_log(tmp_path):
    first, second = make(tmp_path, "sess001"), make(tmp_path, "sess001")
    assert remove_log(first)
    assert second.exists()
    assert remove_log(second)
    assert not second.parent.exists()
    assert remove_log(second), "gone is gone"


def test_room_is_made_from_the_oldest(tmp_path):
    paths = [make(tmp_path, f"sess{number:03d}", size=100) for number in (1, 1, 2, 3)]
    assert make_room(tmp_path, most_bytes=250, most_folders=0) == 2
    assert [log.path for log in find_logs(tmp_path)] == paths[2:]
    assert make_room(tmp_path, most_bytes=10**9, most_folders=1) == 1
    assert [log.path for log in find_logs(tmp_path)] == paths[3:]


def test_a_place_that_cannot_be_written_says_so(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OSError):
        create_log(tmp_path / "file", "sess001", 0)
    assert find_logs(tmp_path / "file") == []
