"""`froude restore`: what a flight has left goes back to the bit, onto the right vehicle, and only on the ground."""

from __future__ import annotations

import json
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from bridge import peer_identity
from bridge.client import Client
from bridge.drive import ListeningDrive
from bridge.errors import PeerLost, PeerSilent
from bridge.link import MemoryLink, open_link
from bridge.param_file import read_values
from bridge.param_operation import ParamValue
from bridge.peer_identity import PeerIdentity
from scenarios import restore_tasks
from scenarios.cli import main
from scenarios.journal_text import JournalEntry, Owner
from scenarios.one_flight import FlightStoppedError, fly
from scenarios.param_journal import SUFFIX, ParamJournal, pending, state_folder
from sitl.errors import FileError
from tests.scenarios.elsewhere import URL, Elsewhere, dies_in, elsewhere, vehicles
from tests.scenarios.striking import flying

__all__ = ["elsewhere", "vehicles"]

ROOT = Path(__file__).parents[2]
PATIENCE_S = 90.0
VEHICLE = PeerIdentity(URL, 1)
ODD_NAN = struct.pack("<I", 0x7FA00001)
QUICK = """
title = "quick"
vehicle = "ant-x"
gain_sets = ["table_2_2/ANT-X"]
takeoff_altitude_m = 3.0
[gate]
hold_s = 0.5
timeout_s = 2.0
[[manoeuvre]]
kind = "step"
amplitude_deg = 10.0
hold_s = 300.0
return_s = 2.0
"""

HOLD = 5
"""COM_OBL_RC_ACT: a vehicle that nobody flies any more stays where it is, until somebody asks."""

Froude = Callable[..., tuple[int, str, str]]


def real(value: float) -> ParamValue:
    return ParamValue("REAL32", struct.pack("<f", value))


def owed(value: float = 5.0, vehicle: PeerIdentity = VEHICLE, utc: str = "20261123T081638Z", **owner: Any) -> Path:
    """A journal that an earlier flight has left: MC_ROLL_P was this, and was set to 12."""
    journal = ParamJournal.begin(
        Owner(vehicle, utc=utc, gain_set="bold", **owner), [JournalEntry("MC_ROLL_P", real(value), real(12.0))]
    )
    journal.close()
    return journal.path


@pytest.fixture
def froude(capsys: pytest.CaptureFixture[str]) -> Froude:
    """Runs the command line in this process; (exit status, standard output, standard error)."""

    def run(*words: object) -> tuple[int, str, str]:
        capsys.readouterr()
        try:
            status = main([str(word) for word in words])
        except SystemExit as end:
            status = int(end.code or 0)
        out, err = capsys.readouterr()
        return status, out, err

    return run


class TestRestores:
    def test_nothing_pending(self, froude: Froude) -> None:
        assert froude("restore") == (0, f"Nothing is pending: no journal in {state_folder()}.\n", "")
        assert froude("restore", "--list")[0] == 0
        status, out, _ = froude("restore", "--json")
        assert (status, json.loads(out)["restored"]) == (0, [])

    def test_what_a_dead_link_has_left(
        self, froude: Froude, quick_job: Any, vehicles: dict[str, Elsewhere], elsewhere: Elsewhere, tmp_path: Path
    ) -> None:
        elsewhere.vehicle.parameters.set_raw("MC_PITCHRATE_FF", ODD_NAN)
        before = elsewhere.raws()
        with pytest.raises(FlightStoppedError):
            fly(quick_job(job={"connect": URL, "patience_s": 0.5}), dies_in("step", elsewhere))
        vehicles[URL] = again = elsewhere.switched_off_and_on()
        assert again.raws() != before
        status, out, err = froude("restore")
        assert (status, err) == (0, "")
        assert again.raws() == before
        assert not list(state_folder().iterdir())
        assert out.startswith(f"system 1 at {URL}: set, ")
        assert "nan (0x7fa00001)" in out
        assert out.endswith("Journal deleted.\n")

    def test_for_machines(self, froude: Froude, elsewhere: Elsewhere) -> None:
        elsewhere.vehicle.parameters.set("MC_ROLL_P", 7.0)
        path = owed(float("inf"), command=("froude", "fly"), run="/runs/1")
        status, out, err = froude("restore", "--list", "--json")
        (listed,) = json.loads(out)["pending"]
        assert (status, err, listed["file"], listed["run"], listed["in_use"]) == (0, "", str(path), "/runs/1", False)
        assert listed["parameters"] == [
            {
                "name": "MC_ROLL_P",
                "type": "REAL32",
                "was": {"value": None, "bits": "0x7f800000"},
                "set_to": {"value": 12.0, "bits": "0x41400000"},
            }
        ]
        status, out, err = froude("restore", "--json")
        (done,) = json.loads(out)["restored"]
        assert (status, err, done["restored"], done["problem"]) == (0, "", True, "")
        (parameter,) = done["parameters"]
        assert parameter["found"]["value"] == 7.0
        assert parameter["put_back"]["bits"] == "0x7f800000"
        assert parameter["changed_by_others"]  # neither what was there nor what a flight had set
        assert elsewhere.vehicle.parameters.get("MC_ROLL_P") == float("inf")

    def test_the_list_changes_nothing_and_says_what_and_whose(self, froude: Froude, elsewhere: Elsewhere) -> None:
        path = owed(run="/runs/1")
        before = elsewhere.raws()
        status, out, _ = froude("restore", "--list")
        assert status == 0
        head, line = out.splitlines()
        assert head.split()[:2] == ["written", "(UTC)"]
        for word in ("2026-11-23 08:16:38", f"system 1 at {URL}", " 1 ", "bold", "/runs/1", str(path)):
            assert word in line
        assert elsewhere.raws() == before
        assert path.exists()

    def test_of_several_the_oldest_is_the_owners(self, froude: Froude, elsewhere: Elsewhere) -> None:
        owed(6.0, utc="20261123T081639Z")
        owed(5.0, utc="20261123T081638Z")
        owed(7.0, utc="20261123T081640Z")
        status, out, _ = froude("restore")
        assert status == 0
        assert out.count("Journal deleted.") == 3
        assert elsewhere.vehicle.parameters.get("MC_ROLL_P") == 5.0

    def test_only_what_was_asked_for(self, froude: Froude, elsewhere: Elsewhere, tmp_path: Path) -> None:
        one, other = owed(5.0), owed(6.0, run=str(tmp_path))
        assert froude("restore", one)[0] == 0
        assert elsewhere.vehicle.parameters.get("MC_ROLL_P") == 5.0
        assert (one.exists(), other.exists()) == (False, True)
        assert froude("restore", tmp_path)[0] == 0  # the folder of its run
        assert elsewhere.vehicle.parameters.get("MC_ROLL_P") == 6.0
        assert not other.exists()

    def test_from_the_backups_of_a_run(
        self, froude: Froude, quick_job: Any, elsewhere: Elsewhere, tmp_path: Path
    ) -> None:
        """Where no journal is left: the files beside the flights, the oldest last."""
        (tmp_path / "flights").mkdir()
        fly(quick_job(job={"connect": URL, "folder": tmp_path / "flights"}))
        later = tmp_path / "flights" / "later.backup.params"
        later.write_text("1\t1\tMC_ROLL_P\t9.5\t9\n1\t1\tMC_AIRMODE\t2\t6\n")
        os.utime(later, ns=(2**62, 2**62))
        elsewhere.vehicle.parameters.set("MC_ROLL_P", 12.0)
        status, out, err = froude("restore", tmp_path)
        assert (status, out) == (2, "")
        assert "the file does not say which vehicle it is of. Say where the vehicle is, such as --connect" in err
        assert froude("restore", tmp_path, "--connect", URL)[0] == 0
        assert elsewhere.vehicle.parameters.get("MC_ROLL_P") == 4.0
        assert elsewhere.vehicle.parameters.get("MC_AIRMODE") == 2
        assert froude("restore", later, "--connect", URL)[0] == 0
        assert elsewhere.vehicle.parameters.get("MC_ROLL_P") == 9.5

    def test_a_vehicle_that_tells_neither_time_nor_position(
        self, froude: Froude, elsewhere: Elsewhere, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """A board whose simulator is absent: a heartbeat and parameters must do."""
        monkeypatch.setattr(peer_identity, "_TRIES", 1)
        elsewhere.only = frozenset(("HEARTBEAT", "PARAM_VALUE"))
        owed(5.0)
        assert froude("restore")[0] == 0
        assert elsewhere.vehicle.parameters.get("MC_ROLL_P") == 5.0

    def test_over_another_link(self, froude: Froude, vehicles: dict[str, Elsewhere], elsewhere: Elsewhere) -> None:
        path = owed(5.0)
        vehicles["serial:///dev/ttyACM0:57600"] = vehicles.pop(URL)
        assert froude("restore", "--connect", "serial:///dev/ttyACM0:57600")[0] == 0  # nothing is armed by this
        assert elsewhere.vehicle.parameters.get("MC_ROLL_P") == 5.0
        assert not path.exists()


class TestRefuses:
    """Exit status 3 or 2, one line per journal that names it, nothing changed, nothing forgotten."""

    def refused(self, froude: Froude, elsewhere: Elsewhere | None, *words: object, status: int = 3) -> str:
        before = elsewhere.raws() if elsewhere else {}
        kept = sorted(state_folder().iterdir()) if state_folder().is_dir() else []
        found, out, err = froude("restore", *words)
        assert (found, out) == (status, "")
        assert "Traceback" not in err
        assert (sorted(state_folder().iterdir()) if state_folder().is_dir() else []) == kept
        assert (elsewhere.raws() if elsewhere else {}) == before
        return err

    def test_another_vehicle(self, froude: Froude, vehicles: dict[str, Elsewhere]) -> None:
        vehicles[URL] = other = Elsewhere(sysid=4)
        path = owed()
        err = self.refused(froude, other)
        assert f"another vehicle answers: system 4 at {URL}, and not system 1 at {URL}" in err
        assert "--yes-other-vehicle" in err
        assert str(path) in err
        assert froude("restore", "--yes-other-vehicle")[0] == 0
        assert other.vehicle.parameters.get("MC_ROLL_P") == 5.0
        assert not path.exists()

    def test_an_armed_one(self, froude: Froude, elsewhere: Elsewhere) -> None:
        path = owed()
        elsewhere.arm()
        err = self.refused(froude, elsewhere)
        assert "the vehicle is armed, and nothing is put back onto an armed vehicle" in err
        assert str(path) in err

    def test_one_that_is_silent(self, froude: Froude, elsewhere: Elsewhere) -> None:
        owed()
        elsewhere.silent = True
        err = self.refused(froude, elsewhere)
        assert f"{URL}: no sign of a MAVLink vehicle within 0.3 s" in err

    def test_one_that_does_not_know_a_parameter_any_more(self, froude: Froude, elsewhere: Elsewhere) -> None:
        journal = ParamJournal.begin(
            Owner(VEHICLE), [JournalEntry("MC_GONE", real(1.0)), JournalEntry("MC_ROLL_P", real(5.0))]
        )
        journal.close()
        assert "MC_GONE" in self.refused(froude, elsewhere)

    def test_one_that_is_being_flown(self, froude: Froude, elsewhere: Elsewhere) -> None:
        journal = ParamJournal.begin(Owner(VEHICLE), [JournalEntry("MC_ROLL_P", real(5.0))])
        assert "another froude is at work on this vehicle" in self.refused(froude, elsewhere)
        assert "(in use by a flight)" in froude("restore", "--list")[1]
        journal.close()

    def test_links_that_do_not_open_and_the_others_are_done(
        self, froude: Froude, vehicles: dict[str, Elsewhere], elsewhere: Elsewhere
    ) -> None:
        good, gone = owed(5.0), owed(vehicle=PeerIdentity("udpin://127.0.0.1:14541", 1))
        status, out, err = froude("restore")
        assert status == 3
        assert "Journal deleted." in out
        assert err.count("\n") == 1
        assert str(gone) in err
        assert (good.exists(), gone.exists()) == (False, True)

    def test_damaged_files_and_the_others_are_done(self, froude: Froude, elsewhere: Elsewhere) -> None:
        good = owed(5.0)
        damaged = state_folder() / f"0{SUFFIX}"
        damaged.write_bytes(good.read_bytes()[:200])
        status, _, err = froude("restore")
        assert status == 2
        assert err.startswith(f"froude: {damaged}: ")
        assert (good.exists(), damaged.exists()) == (False, True)
        assert froude("restore", "--list")[0] == 2

    @pytest.mark.parametrize(
        ("name", "content", "says"),
        [
            ("missing.json", None, "cannot be read"),
            ("missing", None, "does not exist"),
            ("run.json", "{}", "is no journal of froude"),
            ("x.rrd", "", "is no journal, no folder of a run and no .params file"),
            ("x.backup.params", "1 1 MC_ROLL_P six 9\n", "line 1: MC_ROLL_P = 'six' is no REAL32"),
            ("x.backup.params", "# nothing\n", "holds no parameter"),
        ],
    )
    def test_files_that_are_none(
        self, froude: Froude, tmp_path: Path, name: str, content: str | None, says: str
    ) -> None:
        if content is not None:
            (tmp_path / name).write_text(content)
        err = self.refused(froude, None, tmp_path / name, "--connect", URL, status=2)
        assert err.startswith(f"froude: {tmp_path / name}: ")
        assert says in err

    def test_a_folder_without_backups(self, froude: Froude, tmp_path: Path) -> None:
        assert "holds no backup" in self.refused(froude, None, tmp_path, status=2)

    def test_an_address_that_cannot_be_read(self, froude: Froude, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(restore_tasks, "open_link", open_link)
        owed()
        assert "link 'telepathy:" in self.refused(froude, None, "--connect", "telepathy://x", status=2)


def test_ctrl_c_keeps_what_is_not_put_back(
    froude: Froude, elsewhere: Elsewhere, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = owed()
    monkeypatch.setattr(restore_tasks, "settle", lambda *_, **__: signal.raise_signal(signal.SIGTERM))
    status, out, err = froude("restore")
    assert (status, out) == (130, "")
    assert err == "froude: stopping: what is not put back yet is kept\nfroude: interrupted\n"
    assert path.exists()


def test_any_params_file_is_read_to_the_bit(tmp_path: Path) -> None:
    path = tmp_path / "x.params"
    path.write_text("# of another autopilot\n2\t1\tRATE_RLL_P\t0x7fa00001\t9\n2\t1\tBAUD\t-7\t6\n")
    assert read_values(path) == {
        "RATE_RLL_P": ParamValue("REAL32", ODD_NAN),
        "BAUD": ParamValue("INT32", struct.pack("<i", -7)),
    }
    path.write_text("1 1 A 1 9\n1 1 A 2 9\n")
    with pytest.raises(FileError, match="line 2: A is set twice"):
        read_values(path)


class TestListening:
    """A drive without vehicle time."""

    class Clock:
        def __init__(self) -> None:
            self.us = 5_000_000

        def now_us(self) -> int:
            self.us += 20_000
            return self.us

        def sleep_until_us(self, time_us: int) -> int:
            raise AssertionError("a drive never sleeps")

    def listen(self, drive: ListeningDrive, link: MemoryLink) -> None:
        while True:
            drive.wait(link, drive.now_us() + 20_000)

    def test_silence_from_the_beginning_and_later(self) -> None:
        near, far = MemoryLink.pair()
        drive = ListeningDrive(1.0, self.Clock())
        assert drive.knows_time
        with pytest.raises(PeerSilent, match="no sign of a MAVLink vehicle within 1 s"):
            self.listen(drive, near)
        drive = ListeningDrive(1.0, self.Clock())
        far.send(b"x")
        assert drive.wait(near, drive.now_us() + 20_000) == b"x"
        with pytest.raises(PeerLost, match="nothing from the vehicle for 1 s"):
            self.listen(drive, near)


# -- with processes, as a user runs them -----------------------------------------------------------------------------


def start(*words: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "scenarios.cli", *map(str, words)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.fixture
def port() -> Iterator[int]:
    """Where a vehicle speaks to, in a process of its own, faster than time."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        number: int = probe.getsockname()[1]
    process = start("sitl", "ant-x", "--no-log", "--speed", 4, "--link", f"udpout://127.0.0.1:{number}#onboard")
    assert process.stdout is not None
    assert "serving" in process.stdout.readline()
    yield number
    process.kill()
    process.communicate()


def over_udp(port: int, action: Callable[[Client], Any]) -> Any:
    with open_link(f"udpin://127.0.0.1:{port}") as link:
        client = Client(link, ListeningDrive(PATIENCE_S))
        client.connect(PATIENCE_S)
        return action(client)


def wait_for(condition: Callable[[], Any], process: subprocess.Popen[str]) -> Any:
    for _ in range(round(PATIENCE_S / 0.02)):
        if found := condition():
            return found
        assert process.poll() is None, "\n".join(process.communicate())
        time.sleep(0.02)
    return pytest.fail("never seen")


@pytest.fixture
def in_flight(port: int, tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], dict[str, ParamValue]]]:
    """A flight in its manoeuvre, and what its vehicle held before."""

    def prepare(client: Client) -> dict[str, ParamValue]:
        client.upload({"MC_PITCHRATE_FF": (ODD_NAN, "REAL32"), "MC_PITCH_P": (5.25, "REAL32")})
        client.upload({"COM_OBL_RC_ACT": (struct.pack("<i", HOLD), "INT32")})
        return client.read_parameters(["MC_PITCHRATE_FF", "MC_PITCH_P", "MC_ROLL_P", "MC_ROLLRATE_P", "MC_ROLLRATE_I"])

    before = over_udp(port, prepare)
    assert before["MC_PITCHRATE_FF"].raw == ODD_NAN
    (tmp_path / "quick.toml").write_text(QUICK)
    words = ("--connect", f"udpin://127.0.0.1:{port}", "--out", tmp_path / "runs")
    process = start("fly", tmp_path / "quick.toml", *words)
    wait_for(lambda: flying(tmp_path / "runs"), process)
    yield process, before
    process.kill()
    process.communicate()


def test_killed_in_flight_and_restored(
    in_flight: tuple[subprocess.Popen[str], dict[str, ParamValue]], port: int
) -> None:
    process, before = in_flight
    (kept,), _ = pending()
    assert kept.busy
    process.kill()
    process.communicate()
    (kept,), _ = pending()
    assert not kept.busy
    assert kept.owner.command[:2] == ("froude", "fly")
    assert over_udp(port, lambda client: client.read_parameters(before)) != before
    # it hears nobody any more; on the ground it is restored, before that it is not
    refused = start("restore", "--json")
    assert refused.wait(PATIENCE_S) == 3
    assert "the vehicle is armed" in refused.communicate()[1]
    over_udp(port, lambda client: (client.disarm(force=True), client.wait_until(lambda: not client.state.armed, 5.0)))
    restored = start("restore", "--json")
    out, err = restored.communicate(timeout=PATIENCE_S)
    assert (restored.returncode, err) == (0, "")
    (done,) = json.loads(out)["restored"]
    assert {one["name"] for one in done["parameters"]} >= set(before)
    assert over_udp(port, lambda client: client.read_parameters(before)) == before
    assert pending() == ([], [])


def test_a_terminal_that_goes_away_lands_and_restores(
    in_flight: tuple[subprocess.Popen[str], dict[str, ParamValue]], port: int
) -> None:
    """SIGHUP, and nobody who reads what is said about it."""
    process, before = in_flight
    for pipe in (process.stdout, process.stderr):
        assert pipe is not None
        pipe.close()
    process.stdout = process.stderr = None
    process.send_signal(signal.SIGHUP)
    assert process.wait(PATIENCE_S) == 130
    assert pending() == ([], [])
    assert over_udp(port, lambda client: client.read_parameters(before)) == before
