"""A log of ours is a log to pymavlink, and so to MAVProxy and QGroundControl."""

from __future__ import annotations

import errno
import os
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from bridge import behind_file
from bridge.connection import Connection
from bridge.tlog import SIMULATED_EPOCH_US, TlogWriter
from sitl.errors import FileError


def test_pymavlink_reads_it_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MAVLINK20", "1")
    monkeypatch.setenv("MAVLINK_DIALECT", "common")
    from pymavlink import mavutil

    vehicle, ground = Connection(1, 1), Connection(255, 190)
    path = tmp_path / "flight.tlog"
    written = []
    with TlogWriter(path) as log:
        for tick in range(200):
            time_us = tick * 4000
            sender = vehicle if tick % 3 else ground
            log.write(time_us, sender.encode("ATTITUDE", time_boot_ms=tick * 4, roll=0.01 * tick))
            written.append((time_us, sender.sysid, tick * 4))
    assert log.frames == 200

    reader = mavutil.mavlink_connection(str(path), dialect="common")
    read = []
    while (message := reader.recv_match(type="ATTITUDE")) is not None:
        since_us = round(message._timestamp * 1e6) - SIMULATED_EPOCH_US
        read.append((since_us, message.get_srcSystem(), message.time_boot_ms))
    reader.close()
    assert read == written


def test_the_bytes_are_the_stamp_and_the_frame(tmp_path: Path) -> None:
    path = tmp_path / "a.tlog"
    with TlogWriter(path, epoch_us=0) as log:
        log.write(0x0102030405060708, b"\xfdframe")
    assert path.read_bytes() == bytes(range(1, 9)) + b"\xfdframe"


def test_frames_wait_no_longer_than_they_may(tmp_path: Path) -> None:
    path = tmp_path / "a.tlog"
    with TlogWriter(path, waits_s=0.06) as log:
        for time_us in range(0, 1_000_000, 4000):
            log.write(time_us, b"\xfdframe")
            until = time.monotonic() + 10.0  # a thread writes them
            while time_us / 4000 + 1 - path.stat().st_size / 14 > 15:
                assert time.monotonic() < until
    assert path.stat().st_size == 250 * 14


class Slow:
    """A disk on which every write takes a while, and some fail."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.goes_on = threading.Event()
        self.error: OSError | None = None

        def write(file: int, data: Any) -> int:
            self.goes_on.wait(20.0)
            if self.error is not None:
                raise self.error
            return os.write(file, data[:1000])

        monkeypatch.setattr(behind_file, "write", write)


class TestSlowDisk:
    def test_nobody_waits_for_it_and_nothing_is_lost(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        disk, path = Slow(monkeypatch), tmp_path / "a.tlog"
        log = TlogWriter(path, waits_s=0.06, epoch_us=0)
        start = time.monotonic()
        for time_us in range(0, 10_000_000, 4000):
            log.write(time_us, b"\xfdframe")
        assert time.monotonic() - start < 10.0  # a fraction of a second where nothing else runs
        assert path.stat().st_size == 0
        disk.goes_on.set()
        log.close()
        stamps = range(0, 10_000_000, 4000)
        assert path.read_bytes() == b"".join(one.to_bytes(8, "big") + b"\xfdframe" for one in stamps)

    def test_what_went_wrong_is_told_at_the_next_write(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        disk = Slow(monkeypatch)
        log = TlogWriter(tmp_path / "a.tlog", waits_s=0.06)
        log.write(0, b"\xfdframe")
        log.flush()
        disk.error = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        disk.goes_on.set()
        with pytest.raises(FileError, match="No space left on device"):
            log.close()
        log.close()

    def test_one_that_stands_still_is_given_up(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(behind_file, "PATIENCE_S", 0.1)
        monkeypatch.setattr(behind_file, "MOST_WAITING_BYTES", 1000)
        disk = Slow(monkeypatch)
        log = TlogWriter(tmp_path / "a.tlog", waits_s=0.06)

        def write() -> None:
            for time_us in range(0, 10_000_000, 4000):
                log.write(time_us, b"\xfdframe")

        with pytest.raises(FileError, match="the disk takes nothing"):
            write()
        with pytest.raises(FileError, match="the disk takes nothing"):
            log.close()
        disk.goes_on.set()


def test_simulated_flights_make_the_same_file_on_any_day(tmp_path: Path) -> None:
    for name in ("monday", "tuesday"):
        with TlogWriter(tmp_path / name) as log:
            log.write(4000, Connection(1, 1).encode("HEARTBEAT"))
    assert (tmp_path / "monday").read_bytes() == (tmp_path / "tuesday").read_bytes()


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    path = tmp_path / "nowhere" / "a.tlog"
    with pytest.raises(FileError, match=r"a\.tlog: the telemetry log cannot be written \(No such file"):
        TlogWriter(path)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full here")  # noqa: PTH110
def test_a_full_disk_is_one_clear_line() -> None:
    log = TlogWriter("/dev/full")
    log.write(0, bytes(1000))
    with pytest.raises(FileError, match=r"No space left on device.*space left on the disk"):
        log.flush()
    log.write(0, b"one more")
    with pytest.raises(FileError, match="/dev/full: the telemetry log cannot be written"):
        log.close()
    log.close()
