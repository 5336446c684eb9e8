"""Parameters on disk: what comes back, what is refused, and that a file is never half written."""

from __future__ import annotations

import itertools
import math
import os
import struct
import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import bridge.param_file
from bridge.param_file import ParameterFile, preflight_storage, read_parameters, text_of
from sitl.errors import FileError
from sitl.parameters import ParameterTable, to_raw

FOUR_BYTES = st.binary(min_size=4, max_size=4)
SECOND_US = 1_000_000


def write(path: Path, *lines: str) -> Path:
    path.write_text("".join(f"{line}\n" for line in lines))
    return path


def test_what_was_set_is_there_after_a_restart(tmp_path: Path) -> None:
    path = tmp_path / "state.params"
    table = ParameterTable({"CA_ROTOR_COUNT": 4})
    file = ParameterFile(path, table, 3)
    assert not path.exists()
    table.set("MC_ROLL_P", 6.1)
    table.set("MC_AIRMODE", -1)
    table.set("CAL_ACC0_XOFF", math.nan)
    assert file.close()
    again = ParameterTable({"CA_ROTOR_COUNT": 8})
    assert ParameterFile(path, again).notices == ()
    assert again.changed() == ("CAL_ACC0_XOFF", "MC_AIRMODE", "MC_ROLL_P")
    assert all(again.raw(name) == table.raw(name) for name in again.changed())
    assert "3\t1\tMC_ROLL_P\t6.1\t9\n" in path.read_text()
    assert "3\t1\tMC_AIRMODE\t-1\t6\n" in path.read_text()


@given(FOUR_BYTES, FOUR_BYTES)
def test_every_bit_survives_the_text(real: bytes, whole: bytes) -> None:
    table = ParameterTable()
    for name, raw in (("MC_ROLL_P", real), ("MC_AIRMODE", whole)):
        text = text_of(table.spec(name).type, raw)
        assert len(text) <= 16
        assert bridge.param_file._raw_of(name, table.spec(name).type, text) == raw


def test_numbers_are_written_as_people_write_them() -> None:
    for value in (0.1, 0.15, 9.8066, -2.5, 1e-6, 1310988.0, math.inf, -math.inf):
        assert float(text_of("REAL32", to_raw("X", "REAL32", value))) == pytest.approx(value)
    assert text_of("REAL32", to_raw("X", "REAL32", 0.15)) == "0.15"
    assert text_of("REAL32", struct.pack("<f", math.nan)) == "nan"
    assert text_of("REAL32", b"\1\0\xc0\xff") == "0xffc00001"


def test_it_is_written_a_little_after_a_change_and_not_too_often(tmp_path: Path) -> None:
    path = tmp_path / "state.params"
    table = ParameterTable()
    file = ParameterFile(path, table)
    written = []
    text = ""
    for now_us in range(0, 4 * SECOND_US, 4_000):
        if now_us < SECOND_US:
            table.set("MC_ROLL_P", 5.0 + now_us * 1e-6)
        file.poll(now_us)
        if path.exists() and path.read_text() != text:
            text = path.read_text()
            written.append(now_us)
    assert 2 <= len(written) <= 3
    assert 250_000 <= written[0] <= 500_000
    assert all(later - earlier >= 500_000 for earlier, later in itertools.pairwise(written))
    assert written[-1] <= 1.6 * SECOND_US
    assert read_parameters(path, table).raws == {"MC_ROLL_P": table.raw("MC_ROLL_P")}


def test_nothing_is_written_while_nothing_changes(tmp_path: Path) -> None:
    path = write(tmp_path / "state.params", "1\t1\tMC_ROLL_P\t5\t9")
    before = path.stat().st_mtime_ns
    table = ParameterTable()
    file = ParameterFile(path, table)
    table.set("MC_ROLL_P", 5.0)
    table.set("MC_PITCH_P", 7.0)
    table.reset("MC_PITCH_P")
    for now_us in range(0, 2 * SECOND_US, 4_000):
        file.poll(now_us)
    assert file.close()
    assert path.stat().st_mtime_ns == before
    assert list(tmp_path.iterdir()) == [path]


def test_back_at_the_default_it_leaves_the_file(tmp_path: Path) -> None:
    path = write(tmp_path / "state.params", "1\t1\tMC_ROLL_P\t5\t9", "1\t1\tMC_PITCH_P\t5\t9")
    table = ParameterTable()
    file = ParameterFile(path, table)
    table.reset("MC_ROLL_P")
    file.close()
    assert read_parameters(path, table).raws == {"MC_PITCH_P": table.raw("MC_PITCH_P")}


def test_parameters_of_another_version_are_named_and_kept(tmp_path: Path) -> None:
    path = write(tmp_path / "state.params", "1\t1\tMPC_OLD_NAME\t0.5\t9", "1\t1\tMC_ROLL_P\t5\t9")
    table = ParameterTable()
    file = ParameterFile(path, table)
    assert table.changed() == ("MC_ROLL_P",)
    (notice,) = file.notices
    assert "MPC_OLD_NAME" in notice
    assert str(path) in notice
    table.set("MC_PITCH_P", 5.0)
    file.close()
    assert "1\t1\tMPC_OLD_NAME\t0.5\t9\n" in path.read_text()
    assert len(ParameterFile(path, ParameterTable()).notices) == 1


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1\t1\tMC_ROLL_P\t5", "has 4 columns instead of 5"),
        ("MC_ROLL_P = 5", "has 3 columns instead of 5"),
        ("1\t1\tMC_ROLL_P\tfive\t9", "MC_ROLL_P = 'five' is no REAL32"),
        ("1\t1\tMC_ROLL_P\t1_0\t9", "MC_ROLL_P = '1_0' is no REAL32"),
        ("1\t1\tMC_ROLL_P\t1e99\t9", "MC_ROLL_P = 1e+99 does not fit"),
        ("1\t1\tMC_AIRMODE\t1.5\t6", "MC_AIRMODE = '1.5' is no INT32"),
        ("1\t1\tMC_AIRMODE\t4294967296\t6", "MC_AIRMODE = 4294967296 does not fit"),
        ("1\t1\tMC_AIRMODE\t1\t9", "MC_AIRMODE is INT32, the file says REAL32"),
        ("1\t1\tMC_AIRMODE\t1\t5", "MC_AIRMODE has type '5'"),
        ("1\t1\tMC-ROLL\t1\t9", "'MC-ROLL' is no parameter name"),
        ("1\t1\tMC_YAW_P\t1\t9", "MC_YAW_P is set in line 2 already"),
    ],
)
def test_a_damaged_file_is_refused_by_line_and_left_alone(tmp_path: Path, line: str, message: str) -> None:
    path = write(tmp_path / "state.params", "# comment", "1\t1\tMC_YAW_P\t2\t9", "", line)
    before = path.read_bytes()
    table = ParameterTable()
    with pytest.raises(FileError) as caught:
        ParameterFile(path, table)
    assert f"{path}: line 4: " in str(caught.value)
    assert message in str(caught.value)
    assert "nothing has been overwritten" in str(caught.value)
    assert table.changed() == ()
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("data", "message"),
    [(b"# text\n\xff\xfe\0", "line 2: is not text"), (b"#" * 1_000_001, "is larger than 1000000 bytes")],
)
def test_what_is_no_such_file_is_refused(tmp_path: Path, data: bytes, message: str) -> None:
    path = tmp_path / "state.params"
    path.write_bytes(data)
    with pytest.raises(FileError, match=message):
        ParameterFile(path, ParameterTable())


def test_folders_are_refused_before_anything_flies(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="is not a file"):
        ParameterFile(tmp_path, ParameterTable())
    with pytest.raises(FileError, match="its folder does not exist"):
        ParameterFile(tmp_path / "none" / "state.params", ParameterTable())


@given(st.binary(max_size=200) | st.text(max_size=200).map(str.encode))
def test_any_bytes_are_read_or_refused(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "any.params"
    path.write_bytes(data)
    table = ParameterTable()
    try:
        ParameterFile(path, table)
    except FileError:
        assert table.changed() == ()
    assert path.read_bytes() == data


def test_a_disk_that_fails_is_told_and_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "state.params", "1\t1\tMC_ROLL_P\t5\t9")
    before = path.read_bytes()
    table = ParameterTable()
    file = ParameterFile(path, table)
    attempts = 0

    def full(_descriptor: int) -> None:
        nonlocal attempts
        attempts += 1
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    table.set("MC_ROLL_P", 6.0)
    for now_us in range(0, 12 * SECOND_US, 4_000):
        file.poll(now_us)
    assert attempts == 3
    assert file.problem == f"{path}: parameters cannot be written (No space left on device); they are lost at the end"
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
    monkeypatch.undo()
    for now_us in range(12 * SECOND_US, 18 * SECOND_US, 4_000):
        file.poll(now_us)
    assert file.problem == ""
    assert "MC_ROLL_P\t6\t9" in path.read_text()


def test_a_disk_that_stands_still_is_not_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, table = tmp_path / "state.params", ParameterTable()
    file = ParameterFile(path, table, behind=True)
    goes_on, real = threading.Event(), os.fsync

    def slow(descriptor: int) -> None:
        assert goes_on.wait(60.0)
        real(descriptor)

    monkeypatch.setattr(os, "fsync", slow)
    table.set("MC_ROLL_P", 6.0)
    for now_us in range(0, 2 * SECOND_US, 4_000):
        file.poll(now_us)
    table.set("MC_ROLL_P", 7.0)  # while that is written
    for now_us in range(2 * SECOND_US, 4 * SECOND_US, 4_000):
        file.poll(now_us)
    assert not path.exists()
    goes_on.set()
    assert file.close()
    assert "MC_ROLL_P\t7\t9" in path.read_text()
    assert file.problem == ""


def test_a_disk_that_fails_behind_the_vehicle_is_told_once_a_try(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, table = tmp_path / "state.params", ParameterTable()
    file = ParameterFile(path, table, behind=True)
    attempts: list[int] = []

    def full(_descriptor: int) -> None:
        attempts.append(1)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    table.set("MC_ROLL_P", 6.0)
    for now_us in range(0, 12 * SECOND_US, 4_000):
        before = file.failures
        file.poll(now_us)
        for thread in threading.enumerate():
            if thread.name == f"writes {path}":
                thread.join()
        assert file.failures - before in (0, 1)
    assert (len(attempts), file.failures) == (3, 3)
    assert "No space left on device" in file.problem
    monkeypatch.undo()
    assert file.close()
    assert "MC_ROLL_P\t6\t9" in path.read_text()


def test_the_file_is_replaced_in_one_step_and_keeps_its_rights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "state.params", "1\t1\tMC_ROLL_P\t5\t9")
    path.chmod(0o600)
    link = tmp_path / "link.params"
    link.symlink_to(path)
    table = ParameterTable()
    file = ParameterFile(link, table)
    synced = []
    real = os.fsync

    def seen(descriptor: int) -> None:
        synced.append(path.read_text())  # the old file is whole while the new one is written
        real(descriptor)

    monkeypatch.setattr(os, "fsync", seen)
    table.set("MC_ROLL_P", 6.0)
    file.save()
    assert synced == ["1\t1\tMC_ROLL_P\t5\t9\n"]
    assert link.is_symlink()
    assert path.stat().st_mode & 0o777 == 0o600
    assert "MC_ROLL_P\t6\t9" in path.read_text()


# PREFLIGHT_STORAGE


def stored(tmp_path: Path) -> tuple[ParameterTable, ParameterFile]:
    path = write(tmp_path / "state.params", "1\t1\tMC_ROLL_P\t5\t9")
    table = ParameterTable({"CA_ROTOR_COUNT": 4})
    return table, ParameterFile(path, table)


def test_storage_load_returns_to_the_file(tmp_path: Path) -> None:
    table, file = stored(tmp_path)
    table.set("MC_ROLL_P", 8.0)
    table.set("MC_YAW_P", 1.0)
    assert preflight_storage(0.0, table, file) == (True, "")
    assert table.changed() == ("MC_ROLL_P",)
    assert table.get("MC_ROLL_P") == 5.0
    file.path.write_text("nonsense")
    acknowledged, problem = preflight_storage(0.0, table, file)
    assert acknowledged
    assert "line 1" in problem
    assert table.changed() == ("MC_ROLL_P",)


def test_storage_save_writes_at_once(tmp_path: Path) -> None:
    table, file = stored(tmp_path)
    table.set("MC_YAW_P", 1.0)
    assert preflight_storage(1.0, table, file) == (True, "")
    assert "MC_YAW_P\t1\t9" in file.path.read_text()


@pytest.mark.parametrize(
    ("action", "left"),
    [
        (2.0, ("COM_FLIGHT_UUID", "LND_FLIGHT_T_LO")),
        (3.0, ("CAL_BARO0_OFF", "COM_FLIGHT_UUID", "LND_FLIGHT_T_LO", "MC_ROLL_P")),
        (4.0, ()),
    ],
)
def test_storage_resets(tmp_path: Path, action: float, left: tuple[str, ...]) -> None:
    table, file = stored(tmp_path)
    for name in ("COM_FLIGHT_UUID", "LND_FLIGHT_T_LO", "CAL_ACC0_ID", "CAL_MAG1_ROT"):
        table.set(name, 7)
    for name in ("CAL_GYRO0_XOFF", "CAL_BARO0_OFF"):
        table.set(name, 0.5)
    assert preflight_storage(action, table, file) == (True, "")
    assert table.changed() == left
    assert table.get("CA_ROTOR_COUNT") == 4
    file.close()
    again = ParameterTable({"CA_ROTOR_COUNT": 4})
    ParameterFile(file.path, again)
    assert again.changed() == left


@pytest.mark.parametrize("action", [-1.0, 5.0, 9.0, math.nan, math.inf, 1e30])
def test_storage_does_not_answer_what_it_does_not_know(tmp_path: Path, action: float) -> None:
    table, file = stored(tmp_path)
    table.set("MC_YAW_P", 1.0)
    assert preflight_storage(action, table, file) == (False, "")
    assert table.changed() == ("MC_ROLL_P", "MC_YAW_P")


def test_storage_without_a_file_is_accepted() -> None:
    table = ParameterTable()
    table.set("MC_YAW_P", 1.0)
    assert preflight_storage(1.0, table, None) == (True, "")
    assert preflight_storage(0.0, table, None) == (True, "")
    assert table.changed() == ("MC_YAW_P",)
    assert preflight_storage(2.9, table, None) == (True, "")
    assert table.changed() == ()
