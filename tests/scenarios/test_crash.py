"""Runs that end badly, as the programs a user starts: vehicles that die, signals, full disks, ports in use.

Vehicles are processes of their own behind UDP, faster than time. Nothing here depends on how fast: the moments to
strike are read off the files that a run writes, and a manoeuvre that is struck at lasts until then.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from bridge.client import Client
from bridge.drive import NetworkDrive
from bridge.errors import PeerSilent
from bridge.link import open_link
from scenarios import interrupts
from scenarios.flight_files import FlightFiles
from scenarios.one_flight import FlightJob, FlightStoppedError, fly
from scenarios.recorder.recording_end import whole_recording
from scenarios.runner import RunOptions, run_scenario
from scenarios.stored_flight import log_span_s
from scenarios.telemetry import Telemetry
from tests.scenarios.elsewhere import URL, Elsewhere, elsewhere, vehicles
from tests.scenarios.striking import flying
from tests.sockets import family

__all__ = ["elsewhere", "vehicles"]

ROOT = Path(__file__).parents[2]
SPEED = 4
JUDGED_SPEED = 1
"""Where metrics are compared: set-points that come late by a moment of the computer's are late by this much more."""
PATIENCE_S = 60.0

QUICK = """
title = "quick"
vehicle = "ant-x"
gain_sets = ["table_2_2/ANT-X", "table_7_2/ANT-R"]
takeoff_altitude_m = 3.0
[gate]
hold_s = 0.5
timeout_s = 2.0
[[manoeuvre]]
kind = "step"
amplitude_deg = 10.0
hold_s = 2.0
return_s = 2.0
"""
ONE_SET = QUICK.replace(', "table_7_2/ANT-R"', "")
ENDLESS = QUICK.replace("hold_s = 2.0", "hold_s = 300.0")
LONG = QUICK.replace('ANT-R"]', 'ANT-R", "px4_defaults"]').replace("hold_s = 2.0", "hold_s = 15.0")
GAINS = ("MC_ROLL_P", "MC_ROLLRATE_P", "MC_ROLLRATE_I", "MC_ROLLRATE_D", "MC_PITCH_P", "MC_PITCHRATE_P")

Process = subprocess.Popen[str]


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


def froude(*words: object, program: str = "") -> Process:
    """Start the program, or another one that is given the same words."""
    command = [sys.executable, *(["-c", program] if program else ["-m", "scenarios.cli"]), *map(str, words)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.fixture(scope="module", autouse=True)
def _compiled(quick_job: Any) -> None:
    """So that nothing is compiled, and said of it, below."""
    fly(quick_job(manoeuvres=()))


@pytest.fixture
def serve() -> Iterator[Callable[..., Process]]:
    """Starts vehicles that speak to a port of this computer."""
    started: list[Process] = []

    def start(port: int, speed: int = SPEED, files: Sequence[object] = ("--no-log",), program: str = "") -> Process:
        url = f"udpout://127.0.0.1:{port}#onboard"
        process = froude("sitl", "ant-x", *files, "--speed", speed, "--link", url, program=program)
        started.append(process)
        assert process.stdout is not None
        assert "serving" in process.stdout.readline()
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


@pytest.fixture
def quick(tmp_path: Path) -> Path:
    path = tmp_path / "quick.toml"
    path.write_text(QUICK)
    return path


@pytest.fixture
def endless(tmp_path: Path) -> Path:
    """A flight that lasts until it is struck at."""
    path = tmp_path / "endless.toml"
    path.write_text(ENDLESS)
    return path


def wait_for(condition: Callable[[], Any], what: str) -> Any:
    """Look until something is there."""
    for _ in range(round(PATIENCE_S / 0.02)):
        if found := condition():
            return found
        time.sleep(0.02)
    return pytest.fail(f"never saw {what}")


def in_flight(runs: Path, megabytes: float = 0.15) -> Path:
    """Wait until the first flight has logged so much; its run's folder."""

    def seen() -> Path | None:
        logs = [path for path in runs.glob("*/flights/*.partial.tlog") if path.stat().st_size > megabytes * 1e6]
        return logs[0].parents[1] if logs else None

    return Path(wait_for(seen, "a flight"))


def over_udp(runs: Path) -> Path:
    """Wait until the first flight over a link is under way; its run's folder."""
    log: Path = wait_for(lambda: flying(runs), "a flight")
    return log.parents[1]


def ended(process: Process) -> tuple[int, str, list[str]]:
    """Exit status, standard output, lines of standard error."""
    out, err = process.communicate(timeout=PATIENCE_S)
    assert "Traceback" not in err, err
    return process.returncode, out, err.splitlines()


def read(port: int) -> dict[str, Any]:
    """Parameters of the vehicle that speaks to a port."""
    with open_link(f"udpin://127.0.0.1:{port}") as link:
        client = Client(link, NetworkDrive())
        client.connect()
        assert not client.state.armed
        return {name: value.value for name, value in client.read_parameters(GAINS).items()}


def readable(folder: Path, slug: str = "2_2_ant-x") -> Any:
    """run.json of a run that was stopped, after a look at its files; rows of telemetry must be there."""
    run = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    assert run["complete"] is False
    names = sorted(path.name for path in (folder / "flights").iterdir())
    suffixes = (".backup.params", ".params", ".parquet", ".rrd", ".tlog")
    assert set(names) >= {slug + suffix for suffix in suffixes}
    assert not [name for name in names if "part" in name]
    telemetry, _ = Telemetry.from_parquet(folder / "flights" / f"{slug}.parquet")
    flight = next(flight for flight in run["flights"] if slug in flight["files"]["parquet"])
    assert len(telemetry) == flight["rows"] > 100
    assert telemetry.sha256() == flight["telemetry_sha256"]
    return run


# in real time over sockets: on a machine that is busy for a moment a set-point comes late, and a step overshoots more
@pytest.mark.flaky(reruns=2)
class TestOverUdp:
    def test_the_same_verdicts_as_in_memory_and_the_vehicle_is_given_back(
        self, serve: Any, quick: Path, tmp_path: Path
    ) -> None:
        port = free_port()
        serve(port, JUDGED_SPEED)
        before = read(port)
        status, out, err = ended(
            froude("fly", quick, "--connect", f"udpin://127.0.0.1:{port}", "--out", tmp_path, "--json")
        )
        assert (status, err) == (0, [])
        assert read(port) == before
        by_link = json.loads(out)
        _, out, _ = ended(froude("fly", quick, "--out", tmp_path, "--json"))
        in_memory = json.loads(out)
        told = [flight["reason"] for flight in by_link["flights"]]
        assert [flight["outcome"] for flight in by_link["flights"]] == ["PASS", "FAIL"], told
        assert [flight["outcome"] for flight in in_memory["flights"]] == ["PASS", "FAIL"]
        quiet, same = by_link["flights"][0], in_memory["flights"][0]
        for name, within in (("rise_time_s", 0.01), ("overshoot_pct", 0.5), ("droop_deg", 0.2)):
            assert metric(quiet, name) == pytest.approx(metric(same, name), abs=within), name
        for one, other in zip(by_link["flights"], in_memory["flights"], strict=True):
            shakes, also = metric(one, "oscillation_rad_s"), metric(other, "oscillation_rad_s")
            assert shakes == pytest.approx(also, rel=0.1, abs=0.03)
        assert metric(by_link["flights"][1], "oscillation_hz") == pytest.approx(6.5, abs=0.2)

    @pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
    def test_a_signal_in_flight_lands_first(
        self, serve: Any, endless: Path, tmp_path: Path, number: signal.Signals
    ) -> None:
        port = free_port()
        serve(port)
        before = read(port)
        process = froude("fly", endless, "--connect", f"udpin://127.0.0.1:{port}", "--out", tmp_path / "runs")
        folder = over_udp(tmp_path / "runs")
        process.send_signal(number)
        status, out, (first, last) = ended(process)
        assert status == 130
        assert first.startswith("froude: stopping: the vehicle lands and gets its parameters back")
        assert last == f"froude: interrupted. What was flown is in {folder}"
        assert "UNSET" in out
        assert readable(folder)["flights"][0]["reason"].startswith("interrupted")
        assert read(port) == before

    def test_a_second_signal_leaves_the_vehicle_and_says_what_is_left_to_do(
        self, serve: Any, endless: Path, tmp_path: Path
    ) -> None:
        port = free_port()
        serve(port)
        process = froude("fly", endless, "--connect", f"udpin://127.0.0.1:{port}", "--out", tmp_path / "runs")
        folder = over_udp(tmp_path / "runs")
        process.send_signal(signal.SIGINT)
        assert process.stderr is not None
        assert "stopping" in process.stderr.readline()
        time.sleep(0.1)  # the landing has begun; it takes longer than this
        process.send_signal(signal.SIGINT)
        status, _, (last,) = ended(process)
        assert status == 130
        backup = folder / "flights" / "2_2_ant-x.backup.params"
        assert "The vehicle's own parameters were NOT restored: run `froude restore` (they are in " in last
        assert f", and in {backup})" in last
        readable(folder)

    def test_a_vehicle_that_dies_in_flight(self, serve: Any, endless: Path, tmp_path: Path) -> None:
        port = free_port()
        vehicle = serve(port)
        process = froude("fly", endless, "--connect", f"udpin://127.0.0.1:{port}", "--out", tmp_path / "runs")
        folder = over_udp(tmp_path / "runs")
        vehicle.kill()
        status, out, (line,) = ended(process)
        assert status == 3
        assert line.startswith(f"froude: udpin://127.0.0.1:{port} went away: nothing new from the vehicle for 5 s. ")
        assert "NOT restored: run `froude restore` (they are in " in line
        assert line.endswith(f"What was flown is in {folder}")
        assert "The run was interrupted" in out
        (flight,) = readable(folder)["flights"]
        assert flight["outcome"] == "UNSET"

    def test_a_vehicle_that_starts_anew_in_flight(self, serve: Any, endless: Path, tmp_path: Path) -> None:
        port = free_port()
        vehicle, anew = serve(port), serve(port)
        # It waits: on a slow computer a vehicle needs longer to start than anybody waits for its next message.
        anew.send_signal(signal.SIGSTOP)
        process = froude("fly", endless, "--connect", f"udpin://127.0.0.1:{port}", "--out", tmp_path / "runs")
        folder = over_udp(tmp_path / "runs")
        vehicle.kill()
        anew.send_signal(signal.SIGCONT)
        status, _, (line,) = ended(process)
        assert status == 3
        assert "so it has restarted" in line
        readable(folder)

    def test_nobody_there(self, quick_job: Any) -> None:
        job: FlightJob = quick_job(job={"connect": f"udpin://127.0.0.1:{free_port()}", "patience_s": 0.3})
        with pytest.raises(FlightStoppedError) as stop:
            fly(job)
        assert isinstance(stop.value.cause, PeerSilent)
        assert "`froude sitl ant-x` starts one" in str(stop.value.cause)

    def test_a_port_in_use(self, quick: Path, tmp_path: Path) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.bind(("127.0.0.1", 0))
            port = other.getsockname()[1]
            url = f"udpin://127.0.0.1:{port}"
            status, out, (line,) = ended(froude("fly", quick, "--connect", url, "--out", tmp_path / "runs"))
        assert (status, out) == (3, "")
        assert line.startswith(f"froude: 127.0.0.1:{port} is in use by another program")
        assert list((tmp_path / "runs").iterdir()) == []  # nothing was flown, nothing is left


def metric(flight: Any, name: str) -> float | None:
    value: float | None = next(m["value"] for m in flight["metrics"] if m["name"] == name and not m["segment"])
    return value


class TestInMemory:
    def test_ctrl_c(self, tmp_path: Path) -> None:
        process = froude("fly", "demo", "--out", tmp_path)
        folder = in_flight(tmp_path)
        process.send_signal(signal.SIGINT)
        status, out, (line,) = ended(process)
        assert status == 130
        assert line == f"froude: interrupted. What was flown is in {folder}"
        readable(folder, "7_2_ant-r")
        assert "7.2 ANT-R" in out

    def test_ctrl_c_with_flights_side_by_side(self, quick: Path, tmp_path: Path) -> None:
        """As a terminal does it: the processes that fly are in the same group and get it, too."""
        quick.write_text(LONG)
        command = [sys.executable, "-m", "scenarios.cli", "fly", str(quick), "--jobs", "2", "--out", str(tmp_path)]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        process = subprocess.Popen(command, cwd=ROOT, text=True, start_new_session=True, **pipes)  # type: ignore[call-overload]
        folder = in_flight(tmp_path)
        os.killpg(process.pid, signal.SIGINT)
        status, _, (line,) = ended(process)
        assert status == 130
        assert line == f"froude: interrupted. What was flown is in {folder}"
        run = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        # what had begun was flown to its end
        assert {flight["outcome"] for flight in run["flights"]} <= {"PASS", "FAIL"}
        assert not run["complete"]

    def test_killed_outright(self, tmp_path: Path) -> None:
        """No time to tidy up: what has its own name is whole, what is not is called partial and can be read."""
        process = froude("fly", "demo", "--out", tmp_path)
        partial: list[Path] = []
        while not partial:  # stopped between two flights? then the next one
            folder = in_flight(tmp_path, megabytes=0.5)
            process.send_signal(signal.SIGSTOP)
            partial = list((folder / "flights").glob("*.partial.tlog"))
            if not partial:
                process.send_signal(signal.SIGCONT)
        process.kill()
        process.communicate()
        slug = partial[0].name.removesuffix(".partial.tlog")
        names = {path.name for path in (folder / "flights").iterdir()}
        assert {f"{slug}.partial.rrd", f"{slug}.params", f"{slug}.backup.params"} <= names
        assert not names & {f"{slug}.rrd", f"{slug}.tlog", f"{slug}.parquet"}
        assert not (folder / "run.json").exists()
        assert frames(partial[0]) > 1000
        viewer = str(Path(sys.executable).with_name("rerun"))
        done = subprocess.run(
            [viewer, "rrd", "print", str(folder / "flights" / f"{slug}.partial.rrd")],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        assert "/roll" in done.stdout

    def test_killed_outright_with_flights_side_by_side(self, tmp_path: Path) -> None:
        """Those who fly, and who prepares the report, have nobody to work for any more."""
        process = froude("fly", "demo", "--jobs", "2", "--out", tmp_path)
        in_flight(tmp_path)
        started = [pid for pid in family(process.pid) if pid != process.pid]
        assert len(started) >= 4  # those two, the report's helper, and Python's own
        process.kill()
        process.communicate()
        wait_for(lambda: not [pid for pid in started if running(pid)], "their end")


def running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def frames(log: Path) -> int:
    from pymavlink import mavutil

    reader = mavutil.mavlink_connection(str(log), dialect="common")
    count = 0
    while reader.recv_match() is not None:
        count += 1
    reader.close()
    return count


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 20 MB."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=20m", "tmpfs", str(place)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("cannot mount a small disk here")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


class TestFullDisk:
    def test_in_flight(
        self, small_disk: Path, quick_scenario: Any, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The flight is flown to its end and judged; the run stops with the file's name."""
        monkeypatch.setenv("RUST_LOG", "off")

        def fill(now: Any) -> None:
            if now.phase == "step":
                with (small_disk / "filler").open("wb", buffering=0) as filler, contextlib.suppress(OSError):
                    while True:
                        filler.write(bytes(65536))

        result = run_scenario(quick_scenario(), RunOptions(out=small_disk), fill)
        assert "No space left on device" in str(result.stopped)
        assert ".tlog" in str(result.stopped)
        (flight,) = result.run.flights
        assert str(flight.outcome) == "PASS"
        assert result.folder is not None
        names = {path.name for path in (result.folder / "flights").iterdir()}
        assert names == {f"2_2_ant-x{end}" for end in (".backup.params", ".params", ".partial.rrd", ".partial.tlog")}
        assert frames(result.folder / "flights" / "2_2_ant-x.partial.tlog") > 1000

    def test_before_a_flight(self, small_disk: Path, quick: Path) -> None:
        """The second flight does not begin; the first one's verdict and files are there."""
        (small_disk / "filler").write_bytes(bytes(4_000_000))
        status, out, (line,) = ended(froude("fly", quick, "--out", small_disk))
        assert status == 2
        assert "MB are free on its disk. Free some space or choose another --out" in line
        (folder,) = small_disk.glob("2*")
        run = readable(folder)
        assert [flight["outcome"] for flight in run["flights"]] == ["PASS"]
        assert "2.2 ANT-X" in out


class TestReadOnlyDisk:
    @pytest.mark.parametrize("words", [("fly", "demo"), ("sweep", "roll_gains")])
    def test_nothing_is_begun(self, small_disk: Path, words: tuple[str, ...]) -> None:
        remount = ["mount", "-o", "remount,ro", str(small_disk)]
        if subprocess.run(remount, capture_output=True, check=False).returncode:
            pytest.skip("cannot make a disk read-only here")
        status, out, (line,) = ended(froude(*words, "--out", small_disk / "runs"))
        assert (status, out) == (2, "")
        assert "Read-only file system" in line
        assert line.endswith("Choose another folder with --out")

    def test_a_vehicle_flies_without_its_file_and_its_log(self, small_disk: Path, quick: Path, tmp_path: Path) -> None:
        """A flight changes parameters and arms: what cannot be kept is told, and nothing else comes of it."""
        remount = ["mount", "-o", "remount,ro", str(small_disk)]
        if subprocess.run(remount, capture_output=True, check=False).returncode:
            pytest.skip("cannot make a disk read-only here")
        port = free_port()
        url = f"udpout://127.0.0.1:{port}#onboard"
        quick.write_text(ONE_SET)
        files = ("--state", small_disk / "vehicle.params", "--log-dir", small_disk)
        vehicle = froude("sitl", "ant-x", *files, "--speed", JUDGED_SPEED, "--link", url)
        try:
            assert vehicle.stdout is not None
            assert "serving" in vehicle.stdout.readline()
            words = ("--connect", f"udpin://127.0.0.1:{port}", "--out", tmp_path / "runs", "--json")
            status, out, err = ended(froude("fly", quick, *words))
            assert (status, err) == (0, [])
        finally:
            vehicle.terminate()
            ended(vehicle)
        (flight,) = json.loads(out)["flights"]
        assert flight["outcome"] == "PASS", flight["reason"]
        said = [event["text"] for event in flight["events"]]
        for what in ("parameters cannot be written (Read-only file system)", "Logging stopped: "):
            assert [text for text in said if what in text], said


SLOW_DISK = """
import os, sys, time
from bridge import behind_file
synced, append = os.fsync, behind_file._append
behind_file._append = lambda *pieces: (time.sleep(0.4), append(*pieces))
os.fsync = lambda handle: (time.sleep(0.4), synced(handle))[1]
from scenarios.cli import main
sys.exit(main())
"""
"""The program where the disk needs 0.4 s for whatever it is asked: longer than a vehicle waits for its set-points."""


@pytest.mark.flaky(reruns=2)
class TestSlowDisk:
    def test_neither_the_flight_nor_the_vehicle_waits_for_it(self, serve: Any, quick: Path, tmp_path: Path) -> None:
        port, state, logs = free_port(), tmp_path / "vehicle.params", tmp_path / "ulog"
        vehicle = serve(port, JUDGED_SPEED, ("--state", state, "--log-dir", logs), SLOW_DISK)
        before = read(port)
        quick.write_text(ONE_SET)
        words = ("fly", quick, "--connect", f"udpin://127.0.0.1:{port}", "--out", tmp_path / "runs", "--json")
        status, out, err = ended(froude(*words, program=SLOW_DISK))
        assert (status, err) == (0, [])
        (flight,) = json.loads(out)["flights"]
        assert flight["outcome"] == "PASS", flight["reason"]
        assert read(port) == before
        assert min(frames(path) for path in tmp_path.glob("runs/*/flights/*.tlog")) > 1000
        vehicle.terminate()
        assert ended(vehicle)[0] == 0
        assert state.exists()
        (log,) = logs.rglob("*.ulg")
        assert log_duration_s(log) > 8.0


def log_duration_s(path: Path) -> float:
    from pyulog import ULog

    times_us = ULog(str(path)).get_dataset("vehicle_attitude").data["timestamp"]
    return float(times_us[-1] - times_us[0]) * 1e-6


class TestInterrupts:
    """The order of things when Ctrl-C comes while something must be finished."""

    def test_at_once_by_default(self) -> None:
        said: list[str] = []
        with interrupts.caught(lambda: said.append("heard")), pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
        assert said == ["heard"]
        assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL

    def test_after_what_is_being_written(self) -> None:
        done: list[int] = []

        def write() -> None:
            with interrupts.held():
                signal.raise_signal(signal.SIGINT)
                signal.raise_signal(signal.SIGINT)
                done.append(1)

        with interrupts.caught():
            with pytest.raises(KeyboardInterrupt):
                write()
            with interrupts.held():
                done.append(2)  # it was told once
        assert done == [1, 2]

    def test_a_first_one_waits_for_the_landing_and_a_second_one_does_not(self) -> None:
        done: list[str] = []

        def land(signals: int) -> None:
            with interrupts.landing():
                for _ in range(signals):
                    signal.raise_signal(signal.SIGINT)
                done.append("landed")
            with interrupts.held():
                done.append("written")

        with interrupts.caught(), pytest.raises(KeyboardInterrupt):
            land(1)
        assert done == ["landed", "written"]
        with interrupts.caught(), pytest.raises(KeyboardInterrupt):
            land(2)
        assert done == ["landed", "written"]

    def test_what_is_written_in_the_landing_does_not_end_it(self) -> None:
        """The journal goes while the vehicle is given back; after it the streams are put back, too."""
        done: list[str] = []

        def land(signals: int) -> None:
            with interrupts.landing():
                signal.raise_signal(signal.SIGINT)
                with interrupts.held():
                    for _ in range(signals):
                        signal.raise_signal(signal.SIGINT)
                    done.append("journal deleted")
                done.append("landed")
            with interrupts.held():
                done.append("written")

        with interrupts.caught(), pytest.raises(KeyboardInterrupt):
            land(0)
        assert done == ["journal deleted", "landed", "written"]
        with interrupts.caught(), pytest.raises(KeyboardInterrupt):
            land(1)
        assert done == ["journal deleted", "landed", "written", "journal deleted"]


def test_what_a_flight_over_a_link_leaves_lacks_less_than_a_tenth_of_a_second(
    tmp_path: Path, quick_job: Any, elsewhere: Elsewhere
) -> None:
    """Looked at in the middle of it, as if it had been killed there."""
    lost: list[tuple[str, float, float]] = []

    def look(phase: str) -> None:
        if phase in ("step", "land"):
            # who writes the recording does so in a thread of its own
            time.sleep(0.5)
            now_s = elsewhere.vehicle.time_us * 1e-6
            span = log_span_s(tmp_path / "set.partial.tlog")
            assert span is not None
            lost.append(
                (phase, now_s - span[1], now_s - last_row_s(tmp_path / "set.partial.rrd", tmp_path / "copy.rrd"))
            )

    fly(quick_job(job={"connect": URL, "folder": tmp_path}), look)
    assert [phase for phase, *_ in lost] == ["step", "land"]
    assert max(max(seconds) for _, *seconds in lost) < 0.1, lost


def last_row_s(rrd: Path, copy: Path) -> float:
    """Flight time of the last row of roll, s, in what a recording holds by now."""
    import rerun as rr

    shutil.copyfile(rrd, copy)
    with whole_recording(copy) as whole, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a file without an end
        chunks = [chunk for chunk in rr.chunk.RrdReader(whole).stream() if chunk.entity_path == "/roll"]
    batches = [chunk.to_record_batch() for chunk in chunks if not chunk.is_static]
    return max(max(batch.column("flight_time").cast("int64").to_pylist()) for batch in batches) * 1e-9


def test_the_files_of_a_flight_are_there_whole_or_called_partial(tmp_path: Path, quick_job: Any) -> None:
    with FlightFiles(tmp_path, "x", name="x", vehicle=quick_job().flown_vehicle()) as files:
        files.frame(0, b"frame")
        assert {path.name for path in tmp_path.iterdir()} == {"x.partial.rrd", "x.partial.tlog"}
    assert {path.name for path in tmp_path.iterdir()} == {"x.partial.rrd", "x.partial.tlog"}
    assert files.problem is None
