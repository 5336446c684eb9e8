"""Parameters borrowed from a vehicle: nothing is set that is not on disk first, and nothing is forgotten."""

from __future__ import annotations

import errno
import json
import os
import signal
import struct
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.errors import PeerLost, UploadFailed
from bridge.param_operation import ParamValue
from bridge.param_restore import StillArmed, await_parameters, put_back, stages, touched_by
from bridge.peer_identity import Match, PeerIdentity, ask_identity
from scenarios import interrupts, param_loan
from scenarios.flight_files import FlightFiles
from scenarios.journal_text import JournalEntry, Owner
from scenarios.one_flight import FlightStoppedError, fly
from scenarios.param_journal import SUFFIX, JournalBusy, ParamJournal, pending, read_journal, state_folder
from scenarios.param_loan import ParamLoan
from sitl.errors import FileError, UsageError
from sitl.parameters import ParameterTable

sys.path.insert(0, str(Path(__file__).parent))  # a module beside the tests that is no test

from elsewhere import URL, Elsewhere, dies_in, elsewhere, vehicles

__all__ = ["elsewhere", "vehicles"]

BOARD = bytes([0, 2, 0, 0, 0, 0, 0x1F, 0, 0x3A, 0, 0x12, 0x51, 0x34, 0x37, 0x31, 0x30, 0x33, 0x35])
VEHICLE = PeerIdentity(URL, 1)
ODD_NAN = struct.pack("<I", 0x7FA00001)  # a signalling one, which no float of Python carries

ENTRY = {"name": "X", "was": {"mavlink_type": 9, "bits": "0x00000000"}, "set_to": None}

values = st.builds(ParamValue, st.sampled_from(["INT32", "REAL32"]), st.binary(min_size=4, max_size=4))
names = st.text("ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_", min_size=1, max_size=16)
entry_lists = st.lists(
    st.builds(JournalEntry, names, values, st.none() | values), max_size=30, unique_by=lambda entry: entry.name
)
identities = st.builds(
    PeerIdentity, st.text(max_size=40), st.integers(0, 255), st.integers(0, 2**64 - 1), st.binary(max_size=18)
)


def real(value: float) -> ParamValue:
    return ParamValue("REAL32", struct.pack("<f", value))


def journal(*entries: JournalEntry, vehicle: PeerIdentity = VEHICLE, **more: Any) -> ParamJournal:
    made = entries or (JournalEntry("MC_ROLL_P", real(6.5), real(12.0)),)
    return ParamJournal.begin(Owner(vehicle, **more), made)


def journals() -> list[Path]:
    """Whatever is in the state folder, also what should not be."""
    return sorted(state_folder().iterdir()) if state_folder().is_dir() else []


class TestOnDisk:
    @settings(max_examples=60, deadline=None)
    @given(entry_lists, entry_lists, identities, st.lists(st.text(max_size=12), max_size=4), st.text(max_size=12))
    def test_what_is_written_is_read_to_the_bit(
        self,
        entries: list[JournalEntry],
        more: list[JournalEntry],
        vehicle: PeerIdentity,
        words: list[str],
        gain_set: str,
    ) -> None:
        with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
            patch.setenv("FROUDE_STATE_DIR", folder)
            patch.setattr(os, "fsync", lambda _: None)  # a disk takes its time for each
            owner = Owner(vehicle, gain_set, "/some/run", tuple(words), "20261123T081638Z")
            held = ParamJournal.begin(owner, entries)
            held.close()
            ((read,), problems) = pending()
            assert (read.owner, list(read.entries), problems) == (owner, entries, [])
            held.extend(more)
            held.close()
            there = {entry.name for entry in entries}
            ((read,), _) = pending()
            assert list(read.entries) == [*entries, *(entry for entry in more if entry.name not in there)]
            held.remove()
            assert pending() == ([], [])
            assert list(state_folder().iterdir()) == []

    def test_it_can_be_read_by_people_and_only_by_its_owner(self) -> None:
        held = journal(command=("froude", "fly", "--connect", URL), gain_set="softer")
        said = json.loads(held.path.read_text())
        assert said["vehicle"] == {"url": URL, "sysid": 1, "uid": 0, "uid2": ""}
        assert said["command"] == ["froude", "fly", "--connect", URL]
        (parameter,) = said["parameters"]
        assert parameter["name"] == "MC_ROLL_P"
        assert parameter["was"] == {"mavlink_type": 9, "bits": "0x40d00000", "text": "6.5"}
        assert held.path.stat().st_mode & 0o077 == 0
        held.close()

    def test_two_in_one_second_are_two(self) -> None:
        one, two = journal(utc="20261123T081638Z"), journal(utc="20261123T081638Z")
        assert one.path != two.path
        for held in (one, two):
            held.close()
        assert len(pending()[0]) == 2

    @pytest.mark.parametrize("call", ["write", "fsync", "open"])
    def test_a_full_disk_leaves_nothing_new_and_nothing_old_lost(
        self, monkeypatch: pytest.MonkeyPatch, call: str
    ) -> None:
        held = journal()
        before = held.path.read_bytes()

        def full(*_: Any) -> Any:
            raise OSError(errno.ENOSPC, "No space left on device")

        with monkeypatch.context() as patch:
            patch.setattr(os, call, full)
            with pytest.raises(FileError) as new:
                journal(gain_set="another")
            with pytest.raises(FileError) as more:
                held.extend([JournalEntry("MC_ROLLRATE_P", real(0.1))])
        for error in (new, more):
            assert str(state_folder()) in str(error.value)
            assert "No space left on device" in str(error.value)
            assert "FROUDE_STATE_DIR" in str(error.value)
        assert [path.read_bytes() for path in journals()] == [before]
        assert len(held.entries) == 1
        held.close()

    def test_a_folder_that_cannot_be_made(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("")
        monkeypatch.setenv("FROUDE_STATE_DIR", str(tmp_path / "file"))
        with pytest.raises(FileError, match="the vehicle's own parameters cannot be kept here"):
            journal()
        assert pending() == ([], [])

    def test_where_it_is(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        monkeypatch.setenv("FROUDE_STATE_DIR", str(tmp_path))
        assert state_folder() == tmp_path / "restore"
        monkeypatch.setenv("FROUDE_STATE_DIR", "")
        monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "xdg"))
        assert state_folder() == tmp_path / "xdg" / "froude" / "restore"
        monkeypatch.setenv("XDG_STATE_HOME", "relative")
        monkeypatch.setenv("HOME", str(tmp_path))
        assert state_folder() == tmp_path / ".local" / "state" / "froude" / "restore"
        monkeypatch.setattr(Path, "home", lambda: (_ for _ in ()).throw(RuntimeError("no home")))
        with pytest.raises(UsageError, match="set FROUDE_STATE_DIR to a folder"):
            state_folder()


class TestDamaged:
    def test_cut_off_anywhere(self) -> None:
        held = journal()
        whole = held.path.read_bytes()
        held.close()
        for length in range(len(whole) - 1):  # without its last byte, the line's end, it is whole
            held.path.write_bytes(whole[:length])
            with pytest.raises(FileError) as error:
                read_journal(held.path)
            assert str(error.value).startswith(f"{held.path}: ")

    def test_a_byte_changed_anywhere(self) -> None:
        held = journal()
        whole = bytearray(held.path.read_bytes())
        held.close()
        read = read_journal(held.path)
        for index, byte in enumerate(whole[:-1]):
            changed = whole.copy()
            changed[index] = byte ^ 0x10
            held.path.write_bytes(changed)
            (again, problems) = pending()
            assert again == [read] or str(problems[0]).startswith(f"{held.path}: ")  # a blank may be another one

    @pytest.mark.parametrize(
        ("content", "says"),
        [
            (b"", "is empty"),
            (b"{}", "is no journal of froude"),
            (b"[1, 2]", "is no journal of froude"),
            (b"null", "is no journal of froude"),
            (b'"froude_restore_journal"', "is no journal of froude"),
            (b"MC_ROLL_P 6.5\n", "is no whole JSON"),
            (bytes(range(256)), "is no whole JSON"),
            (b"[" * 100_000, "is no whole JSON"),
            (b'{"froude_restore_journal": 2}', "this program reads 1"),
            (b'{"froude_restore_journal": 1}', "its checksum is wrong"),
            (b'{"froude_restore_journal": 1, "sha256": NaN}', "its checksum is wrong"),
        ],
        ids=lambda value: None if isinstance(value, str) else value[:24],
    )
    def test_others_files_are_named_and_the_rest_is_read(self, content: bytes, says: str) -> None:
        held = journal()
        held.close()
        strange = state_folder() / f"0{SUFFIX}"
        strange.write_bytes(content)
        (state_folder() / "notes.txt").write_text("mine")
        (found,), (problem,) = pending()
        assert found.path == held.path
        assert str(problem).startswith(f"{strange}: ")
        assert says in str(problem)

    def test_a_folder_of_that_name(self) -> None:
        journal().close()
        (state_folder() / f"x{SUFFIX}").mkdir()
        found, (problem,) = pending()
        assert len(found) == 1
        assert "cannot be read" in str(problem)

    @pytest.mark.parametrize(
        "change",
        [
            {"vehicle": {}},
            {"parameters": None},
            {"parameters": [ENTRY | {"name": "X" * 17}]},
            {"parameters": [ENTRY | {"name": 3}]},
            {"parameters": [ENTRY | {"was": {"mavlink_type": 2, "bits": "0x00000000"}}]},
            {"parameters": [ENTRY | {"was": {"mavlink_type": [], "bits": "0x00000000"}}]},
            {"parameters": [ENTRY | {"set_to": {"mavlink_type": 9, "bits": "0x0"}}]},
            {"parameters": [ENTRY | {"set_to": 6.5}]},
        ],
        ids=str,
    )
    def test_whole_but_nonsense(self, monkeypatch: pytest.MonkeyPatch, change: dict[str, Any]) -> None:
        held = journal()
        held.close()
        said = json.loads(held.path.read_text()) | change
        del said["sha256"]
        from scenarios import journal_text

        held.path.write_text(json.dumps(said | {"sha256": journal_text._checksum(said)}))
        with pytest.raises(FileError, match="is no whole journal"):
            read_journal(held.path)


class TestHeld:
    def test_one_that_a_flight_holds_is_not_taken(self) -> None:
        held = journal()
        (read,), _ = pending()
        assert read.busy
        with pytest.raises(JournalBusy) as error:
            ParamJournal.take(held.path)
        assert str(held.path) in str(error.value)
        held.extend([JournalEntry("MC_ROLLRATE_P", real(0.1))])  # a new file in its place is held just as well
        with pytest.raises(JournalBusy):
            ParamJournal.take(held.path)
        held.close()
        (read,), _ = pending()
        assert not read.busy
        taken = ParamJournal.take(held.path)
        assert taken is not None
        assert [entry.name for entry in taken.entries] == ["MC_ROLL_P", "MC_ROLLRATE_P"]
        taken.remove()
        assert ParamJournal.take(held.path) is None


class TestWhoseItIs:
    @pytest.mark.parametrize(
        ("one", "other", "match"),
        [
            (PeerIdentity(URL, 1), PeerIdentity(URL, 1), Match.SAME),
            (PeerIdentity(URL, 1), PeerIdentity("udpin://0.0.0.0:14540", 1), Match.SAME),
            (PeerIdentity(URL, 1), PeerIdentity("udpin://:14541", 1), Match.POSSIBLE),
            (PeerIdentity(URL, 1), PeerIdentity(URL, 2), Match.OTHER),
            (PeerIdentity("serial:///dev/a:57600", 1), PeerIdentity("serial:///dev/a:921600", 1), Match.SAME),
            (PeerIdentity("serial:///dev/a", 1), PeerIdentity("serial:///dev/b", 1), Match.POSSIBLE),
            # a board is the same wherever it is plugged in, and whatever its system id is
            (PeerIdentity("serial:///dev/a", 1, 7, BOARD), PeerIdentity(URL, 4, 7, BOARD), Match.SAME),
            (PeerIdentity(URL, 1, 7, BOARD), PeerIdentity(URL, 1, 7, BOARD[:-1] + b"!"), Match.OTHER),
            (PeerIdentity(URL, 1, 1 << 40), PeerIdentity(URL, 1, 1 << 41), Match.OTHER),
            (PeerIdentity(URL, 1, 7, BOARD), PeerIdentity(URL, 1), Match.SAME),
            # numbers that many vehicles have: simulators, boards without one
            (
                PeerIdentity(URL, 1, 9**9, b"\0\x10SIMULATIONID0000"),
                PeerIdentity("tcpout://:5760", 1, 9**9, b"\0\x10SIMULATIONID0000"),
                Match.POSSIBLE,
            ),
            (PeerIdentity(URL, 1, 3), PeerIdentity(URL, 1, 4), Match.SAME),
            (PeerIdentity(URL, 1, 7, BOARD), PeerIdentity(URL, 1, 7, b"\0\x10SIMULATIONID0000"), Match.OTHER),
            (PeerIdentity("udpin://[::1:99999", 1), PeerIdentity("udpin://[::1:99999", 1), Match.SAME),
        ],
    )
    def test_two_identities(self, one: PeerIdentity, other: PeerIdentity, match: Match) -> None:
        assert one.match(other) is match
        assert other.match(one) is match

    def test_it_is_asked_for(self, elsewhere: Elsewhere) -> None:
        client = elsewhere.client()
        client.connect()
        said = ask_identity(client, URL)
        assert (said.url, said.sysid, said.uid2[1:7]) == (URL, 1, b"froude")
        assert said.unique == b""  # every simulated vehicle says so

    def test_a_vehicle_that_does_not_say_is_known_all_the_same(self, elsewhere: Elsewhere) -> None:
        elsewhere.only = frozenset(("HEARTBEAT", "COMMAND_ACK"))
        client = elsewhere.client()
        client.connect()
        assert ask_identity(client, URL) == PeerIdentity(URL, 1)


class TestTheOrder:
    def test_rotors_their_number_outputs_gains_and_what_the_vehicle_corrects(self) -> None:
        rotors = [f"CA_ROTOR{n}_PX" for n in range(8)]
        outputs = ["PWM_MAIN_FUNC5", "HIL_ACT_FUNC1"]
        limits = ["MPC_XY_VEL_MAX", "MC_ROLL_P"]
        chain = ["MPC_XY_CRUISE", "MPC_VEL_MANUAL", "MPC_VEL_MAN_BACK"]
        mixed = [*reversed(chain), *outputs, *limits, "CA_ROTOR_COUNT", *rotors]
        found = stages(mixed)
        assert found[:4] == [rotors, ["CA_ROTOR_COUNT"], outputs, limits]
        assert found[4:] == [[name] for name in chain]
        assert stages(["MC_ROLL_P", "MC_ROLLRATE_P"]) == [["MC_ROLL_P", "MC_ROLLRATE_P"]]

    def test_what_the_vehicle_corrects_meanwhile_is_right_in_the_end(self, elsewhere: Elsewhere) -> None:
        client = elsewhere.client()
        client.connect()
        elsewhere.vehicle.parameters.set("MPC_VEL_MAN_BACK", 3.0)
        before = elsewhere.raws()
        loan = ParamLoan(client, None)
        loan.set({"MPC_XY_VEL_MAX": (0.5, "REAL32")})
        client.wait(1.0)
        assert elsewhere.vehicle.parameters.get("MPC_VEL_MAN_BACK") == 0.5  # down a chain of two
        assert set(touched_by(["MPC_XY_VEL_MAX"])) == set(loan.was)
        loan.give_back()
        client.wait(1.0)
        assert elsewhere.raws() == before

    def test_nothing_is_sent_to_an_armed_vehicle(self, elsewhere: Elsewhere) -> None:
        elsewhere.arm()
        client = elsewhere.client()
        client.connect()
        before = elsewhere.raws()
        with pytest.raises(StillArmed, match="the vehicle is armed, and nothing is put back onto an armed vehicle"):
            put_back(client, {"MC_ROLL_P": real(1.0)})
        client.wait(1.0)
        assert elsewhere.raws() == before

    def test_what_the_vehicle_does_not_take_is_named_and_the_rest_is_put_back(self, elsewhere: Elsewhere) -> None:
        client = elsewhere.client()
        client.connect()
        with pytest.raises(UploadFailed, match="CA_ROTOR_GONE"):
            put_back(client, {"CA_ROTOR_GONE": real(1.0), "MC_ROLL_P": real(7.0)})
        assert elsewhere.vehicle.parameters.get("MC_ROLL_P") == 7.0

    def test_one_that_starts_is_waited_for(self, elsewhere: Elsewhere, monkeypatch: pytest.MonkeyPatch) -> None:
        """A PX4 ignores parameters until its start scripts have run."""
        from bridge.param_protocol import ParamServer

        handle = ParamServer.handle
        booted_us = elsewhere.clock.now_us() + 12_000_000

        def deaf(self: Any, *args: Any) -> Any:
            return handle(self, *args) if elsewhere.clock.now_us() > booted_us else []

        monkeypatch.setattr(ParamServer, "handle", deaf)
        client = elsewhere.client()
        client.connect()
        await_parameters(client, "MC_ROLL_P")
        assert set(client.read_parameters(["MC_ROLL_P"])) == {"MC_ROLL_P"}


class TestInFlight:
    def test_each_is_on_disk_before_it_is_set_and_the_journal_goes_with_the_last(
        self, quick_job: Any, elsewhere: Elsewhere, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        elsewhere.vehicle.parameters.set_raw("MC_PITCHRATE_FF", ODD_NAN)
        before = elsewhere.raws()
        store, sets = ParameterTable.set_raw, []

        def set_raw(table: ParameterTable, name: str, raw: bytes) -> None:
            if table is elsewhere.vehicle.parameters:
                (kept,), _ = pending()
                assert kept.values[name].raw == before[name]
                assert kept.busy
                sets.append(name)
            store(table, name, raw)

        with monkeypatch.context() as patch:
            patch.setattr(ParameterTable, "set_raw", set_raw)
            record = fly(quick_job(job={"connect": URL, "folder": tmp_path, "command": ("froude", "fly")}))
        assert record.outcome.name == "PASS"
        assert {"MC_ROLL_P", "MC_PITCHRATE_FF"} <= set(sets)
        assert elsewhere.raws() == before
        assert journals() == []
        assert record.warnings == ()

    def test_a_vehicle_of_our_own_has_none(
        self, quick_job: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(ParamJournal, "begin", None)
        assert fly(quick_job(job={"folder": tmp_path})).outcome.name == "PASS"
        assert not state_folder().exists()

    @pytest.mark.parametrize("phase", ["step", "restore"])
    def test_it_is_kept_when_the_link_dies_and_the_next_flight_restores_first(
        self, quick_job: Any, vehicles: dict[str, Elsewhere], elsewhere: Elsewhere, tmp_path: Path, phase: str
    ) -> None:
        before = elsewhere.raws()
        job = quick_job(job={"connect": URL, "folder": tmp_path / "flights", "patience_s": 0.5})
        (tmp_path / "flights").mkdir()
        with pytest.raises(FlightStoppedError) as stop:
            fly(job, dies_in(phase, elsewhere))
        assert isinstance(stop.value.cause, PeerLost)
        (kept,), _ = pending()
        assert not kept.busy
        assert str(kept.path) in stop.value.owed
        assert "run `froude restore`" in stop.value.owed
        assert stop.value.owed in stop.value.record.warnings
        assert kept.owner.run == str(tmp_path)
        assert elsewhere.vehicle.parameters.get("MC_ROLL_P") == 6.5

        vehicles[URL] = again = elsewhere.switched_off_and_on()
        assert again.raws() == elsewhere.raws()  # it keeps them, as a PX4 does
        said: list[str] = []
        (tmp_path / "flights" / "set.backup.params").unlink()
        record = fly(job, say=said.append)
        assert record.outcome.name == "PASS"
        (told,) = said
        assert "parameters put back that an earlier flight (gain set set)" in told
        assert told in record.warnings
        assert told in [event.text for event in record.events]
        assert again.raws() == before
        assert journals() == []
        # the new flight's backup is the owner's, not what the first flight had left
        lines = (tmp_path / "flights" / "set.backup.params").read_text().splitlines()
        assert next(line.split()[3] for line in lines if "MC_ROLL_P" in line) == "4.0"

    def test_one_that_is_armed_is_not_restored_and_not_flown(self, quick_job: Any, elsewhere: Elsewhere) -> None:
        journal().close()
        elsewhere.arm()
        before = elsewhere.raws()
        with pytest.raises(FlightStoppedError) as stop:
            fly(quick_job(job={"connect": URL}))
        assert isinstance(stop.value.cause, StillArmed)
        assert elsewhere.raws() == before
        assert len(journals()) == 1

    def test_journals_of_other_vehicles_and_damaged_ones_stay(self, quick_job: Any, elsewhere: Elsewhere) -> None:
        others = journal(vehicle=PeerIdentity(URL, 2)), journal(vehicle=PeerIdentity(URL, 1, 7, BOARD))
        perhaps = journal(vehicle=PeerIdentity("udpin://127.0.0.1:20000", 1))
        for held in (*others, perhaps):
            held.close()
        damaged = state_folder() / f"0{SUFFIX}"
        damaged.write_text("")
        before, there = elsewhere.raws(), journals()
        said: list[str] = []
        record = fly(quick_job(job={"connect": URL}), say=said.append)
        assert record.outcome.name == "PASS"
        assert elsewhere.raws() == before
        assert journals() == there
        assert len(said) == 2
        assert said[0].startswith(f"{damaged}: is empty")
        assert said[1].startswith(f"{perhaps.path} may be owed to this vehicle")
        assert all(text in record.warnings for text in said)

    def test_without_a_place_for_the_journal_nothing_is_set(
        self, quick_job: Any, elsewhere: Elsewhere, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (tmp_path / "file").write_text("")
        monkeypatch.setenv("FROUDE_STATE_DIR", str(tmp_path / "file"))
        revision = elsewhere.vehicle.parameters.revision
        with pytest.raises(FlightStoppedError) as stop:
            fly(quick_job(job={"connect": URL}))
        assert isinstance(stop.value.cause, FileError)
        assert "so none is changed" in str(stop.value.cause)
        assert stop.value.owed == ""
        assert elsewhere.vehicle.parameters.revision == revision
        assert not elsewhere.vehicle.autopilot.armed

    @pytest.mark.parametrize("error", [KeyboardInterrupt, FileError("x.backup.params", "cannot be written")])
    def test_stopped_between_journal_and_first_set_nothing_is_owed(
        self, quick_job: Any, elsewhere: Elsewhere, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, error: Any
    ) -> None:
        def stop_here(*_: Any) -> None:
            assert len(journals()) == 1
            raise error

        monkeypatch.setattr(FlightFiles, "parameters", stop_here)
        revision = elsewhere.vehicle.parameters.revision
        with pytest.raises(FlightStoppedError) as stop:
            fly(quick_job(job={"connect": URL, "folder": tmp_path}))
        assert stop.value.owed == ""
        assert elsewhere.vehicle.parameters.revision == revision
        assert journals() == []

    def test_a_signal_while_the_journal_is_written_waits_for_its_end(
        self, quick_job: Any, elsewhere: Elsewhere, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        begin = ParamJournal.begin.__func__  # type: ignore[attr-defined]

        def interrupted(cls: Any, *args: Any) -> Any:
            signal.raise_signal(signal.SIGHUP)
            signal.raise_signal(signal.SIGINT)
            return begin(cls, *args)

        monkeypatch.setattr(param_loan.ParamJournal, "begin", classmethod(interrupted))
        revision = elsewhere.vehicle.parameters.revision
        with interrupts.caught(), pytest.raises(FlightStoppedError) as stop:
            fly(quick_job(job={"connect": URL}))
        assert isinstance(stop.value.cause, KeyboardInterrupt)
        assert journals() == []  # nothing had been sent, so nothing is owed
        assert elsewhere.vehicle.parameters.revision == revision

    def test_a_second_signal_in_the_restoring_leaves_the_journal(self, quick_job: Any, elsewhere: Elsewhere) -> None:
        def progress(phase: str) -> None:
            if phase in ("step", "restore"):
                signal.raise_signal(signal.SIGTERM)

        with interrupts.caught(), pytest.raises(FlightStoppedError) as stop:
            fly(quick_job(job={"connect": URL}), progress)
        (kept,), _ = pending()
        assert str(kept.path) in stop.value.owed


class TestALoan:
    def test_what_is_touched_later_is_written_down_before_it_is_sent(
        self, elsewhere: Elsewhere, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        before = elsewhere.raws()
        client = elsewhere.client()
        client.connect()
        loan = ParamLoan(client, Owner(VEHICLE))
        loan.set({"MC_ROLL_P": (9.0, "REAL32")})
        sent: list[str] = []
        upload = client.upload

        def look(values: Any, *args: Any) -> None:
            ((kept,), _) = pending()
            assert set(values) <= set(kept.values)
            sent.extend(values)
            upload(values, *args)

        monkeypatch.setattr(client, "upload", look)
        loan.set({"MC_AIRMODE": (1, "INT32"), "MC_ROLL_P": (8.0, "REAL32")})
        assert sent == ["MC_AIRMODE", "MC_ROLL_P"]
        ((kept,), _) = pending()
        assert kept.values["MC_ROLL_P"].raw == before["MC_ROLL_P"]  # the owner's, not the 9 in between
        loan.give_back()
        assert elsewhere.raws() == before
        assert journals() == []

    def test_one_that_cannot_be_written_down_is_not_sent(
        self, elsewhere: Elsewhere, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        client = elsewhere.client()
        client.connect()
        loan = ParamLoan(client, Owner(VEHICLE))
        loan.set({"MC_ROLL_P": (9.0, "REAL32")})
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(OSError(errno.EIO, "Input/output error")))
            with pytest.raises(FileError, match="Input/output error"):
                loan.set({"MC_AIRMODE": (1, "INT32")})
        assert elsewhere.vehicle.parameters.get("MC_AIRMODE") == 0
        loan.give_back()
        assert elsewhere.vehicle.parameters.get("MC_ROLL_P") == 4.0
        assert journals() == []
