"""Kills `fly`, `sitl`, `hil` and `sweep` at random moments, and looks at what is left.

    python tests/bench/kill_loop.py --times 200 --seed 1        the commands in turn
    python tests/bench/kill_loop.py --only link --times 20      one of them

Each kill is a SIGKILL of the one process that was started, in a folder of its own; what that process had started has
to end by itself. Then: every file that has its name is whole, recordings end at most a tenth of a second before the
kill, the vehicle gets back what it had, ports and locks are free, and the same command succeeds. What a recording may
lack is counted in vehicle time where that is the clock's; a process that had to wait for a processor is forgiven that
wait. Prints a table of counts; exit status 1 if there was a finding, each printed with the seed that makes it again:

    python tests/bench/kill_loop.py --only link --times 1 --seed SEED
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import uuid
import warnings
from collections import Counter, deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

TESTS = Path(__file__).resolve().parents[1]
ROOT = TESTS.parent
sys.path[:0] = [str(TESTS), str(ROOT)]

from bridge.client import Client  # noqa: E402
from bridge.connection import Connection  # noqa: E402
from bridge.drive import ListeningDrive  # noqa: E402
from bridge.errors import UploadFailed  # noqa: E402
from bridge.link import open_link  # noqa: E402
from bridge.param_file import read_values  # noqa: E402
from bridge.param_operation import ParamValue  # noqa: E402
from sitl.parameters import ParameterTable  # noqa: E402

MOST_LOST_S = 0.1
GONE_S = 5.0
"""Within which everything that a killed process has started must have ended."""
PATIENCE_S = 120.0
COUNTED_BY_THE_VEHICLE = ("LND_FLIGHT_T_HI", "LND_FLIGHT_T_LO", "COM_FLIGHT_UUID")

SCENARIO = """
title = "quick"
vehicle = "ant-x"
gain_sets = [{sets}]
takeoff_altitude_m = 2.5
[gate]
hold_s = 0.5
timeout_s = 3.0
[[manoeuvre]]
kind = "step"
amplitude_deg = 10.0
hold_s = {hold_s}
return_s = 1.0
"""
SWEEP = """
title = "small"
samples = 40
seed = 3
objectives = ["rise_time_s", "overshoot_pct"]
[design]
kind = "sobol"
points = 2000
[axes]
MC_ROLL_P = { from = 2.0, to = 12.0 }
MC_ROLLRATE_P = { from = 0.02, to = 0.12 }
vehicle = ["ant-x", "ant-r"]
[[limit]]
metric = "overshoot_pct"
max = 20.0
[[manoeuvre]]
kind = "step"
amplitude_deg = 5.0
hold_s = 2.0
return_s = 0.0
"""


class Finding(Exception):
    """Something that must not happen."""


def expect(condition: object, what: str) -> None:
    if not condition:
        raise Finding(what)


def wait_for(condition: Callable[[], Any], what: str, patience_s: float = PATIENCE_S) -> Any:
    until = time.monotonic() + patience_s
    while time.monotonic() < until:
        if found := condition():
            return found
        time.sleep(0.01)
    raise Finding(f"never seen: {what}")


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Program:
    """`froude`, started in a folder; what it says goes into files there.

    Args:
        place: of this kill. words: the command line. mark: in the environment, which all that it starts inherits.
    """

    def __init__(self, place: Path, *words: object, start: str = "-m scenarios.cli") -> None:
        self.mark = uuid.uuid4().hex
        self.words = [str(word) for word in words]
        self.out, self.err = place / f"{self.mark}.out", place / f"{self.mark}.err"
        environment = {
            **os.environ,
            "FROUDE_STATE_DIR": str(place / "state"),
            "FROUDE_KILL_MARK": self.mark,
            "PYTHONPATH": str(ROOT),
            "TMPDIR": str(place),
        }
        with self.out.open("wb") as out, self.err.open("wb") as err:
            command = [sys.executable, *start.split(), *self.words]
            self.process = subprocess.Popen(
                command, cwd=place, env=environment, stdout=out, stderr=err, start_new_session=True
            )
        self._delays: deque[tuple[float, float]] = deque(maxlen=200)

    def said(self) -> str:
        return self.out.read_text(errors="replace") + self.err.read_text(errors="replace")

    def alive(self) -> bool:
        return self.process.poll() is None

    def delay_s(self) -> float:
        """How long its threads have waited for a processor so far."""
        waited = 0
        for task in Path(f"/proc/{self.process.pid}/task").glob("*/schedstat"):
            with contextlib.suppress(OSError, IndexError):
                waited = max(waited, int(task.read_text().split()[1]))
        return waited * 1e-9

    def live(self, seconds: float) -> None:
        """Let it live so long, or until it ends by itself."""
        until = time.monotonic() + seconds
        while (now := time.monotonic()) < until and self.alive():
            self._delays.append((now, self.delay_s()))
            time.sleep(min(0.01, until - now))

    def waited_s(self) -> float:
        """What it has waited for a processor lately."""
        lately = [delay for at, delay in self._delays if at > time.monotonic() - 0.4]
        return lately[-1] - lately[0] if lately else 0.0

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def relatives(self) -> list[int]:
        found = []
        for path in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                running = (path / "stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
                if running and self.mark.encode() in (path / "environ").read_bytes():
                    found.append(int(path.name))
        return found

    def gone(self) -> None:
        """Nobody of it is left."""
        try:
            wait_for(lambda: not self.relatives(), "the end of what it had started", GONE_S)
        except Finding:
            lines = [Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ") for pid in self.relatives()]
            for pid in self.relatives():
                os.kill(pid, signal.SIGKILL)
            raise Finding(f"left running: {lines}") from None

    def ended(self, *statuses: int) -> str:
        """What it has said on standard output, once it has ended by itself."""
        try:
            status = self.process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.kill()
            raise Finding(f"{self.words}: does not end; {self.said()[-500:]}") from None
        expect("Traceback" not in self.said(), f"{self.words}: {self.said()}")
        expect(status in (statuses or (0,)), f"{self.words}: exit status {status}; {self.said()[-800:]}")
        self.gone()
        return self.out.read_text(errors="replace")


class Tap:
    """Hears a vehicle on a port of its own: what its time was at last."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.2)
        self.port: int = self._socket.getsockname()[1]
        self.time_s = 0.0
        self._stop = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        connection = Connection(250, 190, datagram=True)
        while not self._stop:
            with contextlib.suppress(TimeoutError):
                for message in connection.receive(self._socket.recv(65536)):
                    if message.name == "ATTITUDE":
                        self.time_s = message.time_boot_ms * 1e-3

    def close(self) -> None:
        self._stop = True
        self._thread.join()
        self._socket.close()


# -- what is looked at -------------------------------------------------------------------------------------------


def last_row_s(rrd: Path) -> float | None:
    """Flight time of the last row of roll in a recording, s."""
    import rerun as rr

    from scenarios.recorder.recording_end import whole_recording

    last = None
    with whole_recording(rrd) as whole, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a file without an end
        for chunk in rr.chunk.RrdReader(whole).stream():
            if chunk.entity_path == "/roll" and not chunk.is_static:
                times = chunk.to_record_batch().column("flight_time").cast("int64").to_pylist()
                last = max([*times, last or 0])
    return None if last is None else last * 1e-9


def frames(log: Path) -> int:
    """Whole frames of a .tlog; whatever stands between two of them is a finding."""
    from pymavlink import mavutil

    reader = mavutil.mavlink_connection(str(log), dialect="common")
    count = 0
    while (message := reader.recv_match()) is not None:
        expect(message.get_type() != "BAD_DATA", f"{log}: bytes that are no frame")
        count += 1
    reader.close()
    return count


def values_in(path: Path) -> dict[str, ParamValue]:
    """What a vehicle's file of parameters holds; nothing if nothing was changed, or it was killed before that."""
    if not path.exists():
        return {}
    text = path.read_text(encoding="utf-8")
    expect(text.startswith("#") and text.endswith("\n"), f"{path}: whole")
    return read_values(path) if any(line[:1].isdigit() for line in text.splitlines()) else {}


def look_at_runs(place: Path, runs: Path, counts: Counter[str]) -> Path | None:
    """Every file of the only run, whole or partial; its folder."""
    import pyarrow.parquet as pq

    folders = [path for path in runs.iterdir() if path.is_dir()] if runs.is_dir() else []
    for folder in folders:
        for path in folder.rglob("*"):
            if path.suffix == ".json" and ".part" not in path.name:
                json.loads(path.read_text(encoding="utf-8"))
                counts[f"{path.name} whole"] += 1
            elif path.suffix == ".parquet":
                pq.read_table(path)
                counts["parquet whole"] += 1
            elif path.suffix == ".tlog":
                if path.stat().st_size:
                    frames(path)
                counts["tlog read"] += 1
            elif path.suffix == ".rrd":
                if path.stat().st_size:
                    last_row_s(path)
                counts["partial rrd read" if ".partial" in path.name else "rrd read"] += 1
    Program(place, "review", "--out", runs, "--list").ended(0, 2)
    if not folders:
        return None
    (folder,) = folders
    if any((folder / "flights").glob("*.parquet")) or (folder / "run.json").exists():
        Program(place, "review", folder, "--html").ended(0)
        counts["report made"] += 1
    else:
        Program(place, "review", folder, "--html").ended(0, 2)
    return folder


def over_udp(port: int, action: Callable[[Client], Any]) -> Any:
    with open_link(f"udpin://127.0.0.1:{port}") as link:
        client = Client(link, ListeningDrive(PATIENCE_S))
        client.connect(PATIENCE_S)
        return action(client)


def held(port: int) -> dict[str, ParamValue]:
    """All that a vehicle holds, but for what it counts itself."""
    names = [name for name in ParameterTable().names if name not in COUNTED_BY_THE_VEHICLE]
    return dict(over_udp(port, lambda client: client.read_parameters(names, PATIENCE_S)))


def on_the_ground(client: Client) -> None:
    client.disarm(force=True)
    expect(client.wait_until(lambda: not client.state.armed, 5.0), "a vehicle that disarms")


# -- the commands ------------------------------------------------------------------------------------------------


class Kill:
    """One kill of one command.

    Args:
        place: its folder. chance: its random numbers. counts: what was seen.
    """

    def __init__(self, place: Path, chance: random.Random, counts: Counter[str]) -> None:
        self.place, self.chance, self.counts = place, chance, counts
        self.programs: list[Program] = []

    def start(self, *words: object, **how: str) -> Program:
        self.programs.append(Program(self.place, *words, **how))
        return self.programs[-1]

    def close(self) -> None:
        for program in self.programs:
            if program.alive():
                program.kill()

    def strike(self, program: Program, longest_s: float) -> float:
        """Kill it at a random moment; the monotonic time of it."""
        program.live(self.chance.uniform(0.05, longest_s))
        alive = program.alive()
        program.kill()
        at = time.monotonic()
        self.counts["killed" if alive else "had ended"] += 1
        program.gone()
        return at

    def lost(self, what: str, lost_s: float, forgiven_s: float = 0.0) -> None:
        """Count how much a recording lacks."""
        self.counts[f"{what}: looked at"] += 1
        self.counts[f"{what}: most lost, ms"] = max(self.counts[f"{what}: most lost, ms"], round(1e3 * lost_s))
        expect(lost_s <= MOST_LOST_S + forgiven_s, f"{what}: {lost_s:.3f} s lost, {forgiven_s:.3f} of them forgiven")

    def scenario(self, sets: int, hold_s: float) -> Path:
        path = self.place / "quick.toml"
        names = ['"table_2_2/ANT-X"', '"table_7_2/ANT-R"', '"table_7_2/ADAM-0"'][:sets]
        path.write_text(SCENARIO.format(sets=", ".join(names), hold_s=hold_s))
        return path

    def fly(self) -> None:
        """In memory: many flights, some of them side by side."""
        jobs = self.chance.choice((1, 1, 2))
        words = ("fly", self.scenario(3, 10.0), "--jobs", jobs)
        program = self.start(*words, "--out", self.place / "runs")
        program.live(self.chance.uniform(0.05, 9.0))
        alive, at_ns = program.alive(), time.time_ns()
        program.kill()
        waited_s = program.waited_s()
        self.counts["killed" if alive else "had ended"] += 1
        program.gone()
        partial = list(self.place.glob("runs/*/flights/*.partial.tlog"))
        for log in partial if jobs == 1 else ():
            # it grows with every half second of vehicle time: by its last write one knows how much waited
            written = log.stat().st_mtime_ns
            rows = log.with_name(log.name.replace(".tlog", ".rrd"))
            if last_row_s(rows) is not None:
                self.lost("rrd in memory", (at_ns - max(written, rows.stat().st_mtime_ns)) * 1e-9, waited_s)
        look_at_runs(self.place, self.place / "runs", self.counts)
        self.start(*words, "--out", self.place / "again").ended()

    def link(self) -> None:
        """Over UDP, at the pace of the clock: what the vehicle holds is at stake, too."""
        port, tap = free_port(), Tap()
        serve = (
            *("sitl", "ant-x", "--no-log", "--state", self.place / "vehicle.params"),
            *("--link", f"udpout://127.0.0.1:{port}#onboard", "--link", f"udpout://127.0.0.1:{tap.port}#onboard"),
        )
        vehicle = self.start(*serve)
        wait_for(lambda: "serving" in vehicle.said(), "a vehicle")
        before = held(port)
        url, runs = f"udpin://127.0.0.1:{port}", self.place / "runs"
        program = self.start("fly", self.scenario(1, 4.0), "--connect", url, "--out", runs)
        program.live(self.chance.uniform(1.0, 28.0))
        alive = program.alive()
        now_s, waited_s = tap.time_s, program.waited_s()
        program.kill()
        self.counts["killed" if alive else "had ended"] += 1
        program.gone()
        for rrd in runs.glob("*/flights/*.partial.rrd"):
            last_s = last_row_s(rrd)
            if last_s is not None:
                self.lost("rrd over a link", now_s - last_s, waited_s)
        look_at_runs(self.place, runs, self.counts)
        self.restored(port, before)
        vehicle.kill()
        vehicle.gone()
        tap.close()
        kept = self.place / "vehicle.params"
        expect(set(values_in(kept)) <= set(before), "a file of the vehicle's parameters")
        vehicle = self.start(*serve, "--speed", 8)
        wait_for(lambda: "serving" in vehicle.said(), "the vehicle again")
        expect(held(port) == before, "the vehicle holds what it had, after a start, too")
        self.start("fly", self.scenario(1, 1.0), "--connect", url, "--out", self.place / "again").ended()
        expect(held(port) == before, "the vehicle holds what it had after the next flight")

    def restored(self, port: int, before: dict[str, ParamValue]) -> None:
        journals = list((self.place / "state" / "restore").glob("*.journal.json"))
        json.loads(self.start("restore", "--list", "--json").ended())
        over_udp(port, on_the_ground)
        if journals:
            self.counts["journals restored"] += 1
            self.start("restore").ended()
        kept = [path.name for path in (self.place / "state").rglob("*") if path.is_file()]
        expect(not [name for name in kept if not name.endswith(".part")], f"journals left: {kept}")
        expect(held(port) == before, "the vehicle holds what it had")

    def sitl(self) -> None:
        """A vehicle that is spoken to, flies, logs and keeps its parameters."""
        from pyulog import ULog

        port, tap = free_port(socket.SOCK_STREAM), Tap()
        state = self.place / "vehicle.params"
        words = (
            *("sitl", "ant-x", "--state", state, "--log-dir", self.place / "ulog"),
            *("--link", f"tcpin://127.0.0.1:{port}", "--link", f"udpout://127.0.0.1:{tap.port}#onboard"),
        )
        program = self.start(*words)
        wait_for(lambda: "serving" in program.said(), "a vehicle")
        values: list[float] = []
        speaking = threading.Thread(target=self._speak, args=(port, values, program), daemon=True)
        speaking.start()
        program.live(self.chance.uniform(0.05, 14.0))
        now_s, waited_s = tap.time_s, program.waited_s()
        program.kill()
        self.counts["killed"] += 1
        program.gone()
        speaking.join(20.0)
        kept = values_in(state).get("MC_ROLL_P")
        if kept is not None:
            self.counts["state whole"] += 1
            expect(round(float(kept.value), 3) in [round(one, 3) for one in values], f"kept {kept}, sent {values[-3:]}")
        for log in self.place.glob("ulog/**/*.ulg"):
            last_s = ULog(str(log)).last_timestamp * 1e-6
            self.counts["ulog read"] += 1
            self.lost("ulog", now_s - last_s, waited_s)
        tap.close()
        again = self.start(*words)
        wait_for(lambda: "serving" in again.said(), "a vehicle again, on the same port")
        if kept is not None:
            with open_link(f"tcpout://127.0.0.1:{port}") as link:
                client = Client(link, ListeningDrive(PATIENCE_S))
                client.connect(PATIENCE_S)
                found = client.read_parameters(["MC_ROLL_P"])["MC_ROLL_P"]
            expect(found == kept, f"kept {kept}, found {found}")
        again.process.send_signal(signal.SIGTERM)
        again.ended()

    def _speak(self, port: int, values: list[float], program: Program) -> None:
        """Change a parameter again and again, and take off meanwhile."""
        try:
            with open_link(f"tcpout://127.0.0.1:{port}") as link:
                client = Client(link, ListeningDrive(2.0))
                client.connect(10.0)
                client.make_ready(20.0)
                client.arm()
                client.takeoff(2.5)
                while program.alive():
                    values.append(5.0 + 0.01 * len(values))
                    client.upload({"MC_ROLL_P": (values[-1], "REAL32")})
                    client.wait(0.05)
        except Exception as error:
            if program.alive() and not isinstance(error, UploadFailed | OSError):
                print(f"  who speaks: {error!r}")

    def hil(self) -> None:
        """The plant in lockstep, under a stand-in for PX4."""
        port = free_port(socket.SOCK_STREAM)
        words = ("hil", "ant-x", "--link", f"tcpin://127.0.0.1:{port}", "--status", "--json")
        program = self.start(*words)
        autopilot = self.start("--port", port, "--armed", start=str(TESTS / "px4_stand_in.py"))
        self.strike(program, 6.0)
        if autopilot.alive() and "in lockstep" not in program.said() and not program.said():
            autopilot.kill()  # nobody ever came
        wait_for(lambda: not autopilot.alive() or not program.said(), "the end of the autopilot")
        autopilot.kill()
        again = self.start(*words, "--seconds", 2)
        autopilot = self.start("--port", port, "--armed", start=str(TESTS / "px4_stand_in.py"))
        report = json.loads(again.ended())
        expect(report["answered"] > 100, f"lockstep again: {report}")
        self.counts["lockstep again"] += 1
        autopilot.ended()

    def sweep(self) -> None:
        """Chunks, and workers that have nobody to work for any more."""
        engine = self.chance.choice(
            (("--engine", "in-process"), ("--engine", "processes", "--jobs", "2"), ("--dask", "local", "--jobs", "2"))
        )
        file = self.place / "small.toml"
        file.write_text(SWEEP)
        out = self.place / "sweeps"
        program = self.start("sweep", file, "--out", out, *engine)
        self.strike(program, 14.0)
        self.counts[f"killed {engine[1]}"] += 1
        begun = [path.parent for path in out.glob("*/sweep.json")]
        self._look_at(out)
        if begun:
            Program(self.place, "sweep", "--resume", begun[0]).ended()
            self.counts["resumed"] += 1
        else:
            Program(self.place, "sweep", file, "--out", out).ended()
        Program(self.place, "sweep", "--show", "--out", out, "--json").ended()
        self._look_at(out)
        expect(not list(out.rglob("*.part")), f"left: {list(out.rglob('*.part'))}")
        rows = [int(json.loads(path.read_text())["points"]) for path in out.glob("*/sweep.json")]
        expect(len(rows) == 1, f"sweeps: {list(out.iterdir())}")

    def _look_at(self, out: Path) -> None:
        import pyarrow.parquet as pq

        for path in out.rglob("*.parquet"):
            pq.read_table(path)
            self.counts["parquet whole"] += 1
        for path in out.rglob("*.json"):
            json.loads(path.read_text(encoding="utf-8"))


COMMANDS = ("fly", "link", "sitl", "hil", "sweep")


@contextlib.contextmanager
def place_of(keep: bool) -> Iterator[Path]:
    place = Path(tempfile.mkdtemp(prefix="kill-"))
    yield place
    if not keep:
        shutil.rmtree(place, ignore_errors=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1, help="of the first kill; the next one has the next")
    parser.add_argument("--only", choices=COMMANDS)
    parser.add_argument("--minutes", type=float, default=240.0, help="begin no further kill after so many")
    parser.add_argument("--keep", action="store_true", help="keep every folder; without, those of findings are")
    args = parser.parse_args()
    counts = {name: Counter[str]() for name in COMMANDS}
    findings: list[str] = []
    until = time.monotonic() + 60.0 * args.minutes
    for number in range(args.times):
        if time.monotonic() > until:
            print(f"{args.times - number} kills left out: no time")
            break
        seed = args.seed + number
        name = args.only or COMMANDS[seed % len(COMMANDS)]
        with place_of(keep=True) as place:
            kill = Kill(place, random.Random(seed), counts[name])
            began = time.monotonic()
            said = "ok"
            try:
                getattr(kill, name)()
            except Exception as error:
                said = (
                    f"FINDING {error!r} in {place}" if not isinstance(error, Finding) else f"FINDING {error}, {place}"
                )
                findings.append(f"--only {name} --times 1 --seed {seed}: {said}")
            finally:
                kill.close()
            print(f"{number + 1:4d} seed {seed} {name:6s} {time.monotonic() - began:5.1f} s  {said}", flush=True)
            if said == "ok" and not args.keep:
                shutil.rmtree(place, ignore_errors=True)
    for name, seen in counts.items():
        print(f"{name}: " + ", ".join(f"{what} {count}" for what, count in sorted(seen.items())))
    for finding in findings:
        print(finding)
    return 1 if findings else 0


if __name__ == "__main__":
    raise SystemExit(main())
