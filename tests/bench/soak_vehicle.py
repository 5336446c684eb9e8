"""A vehicle that flies for a long time under two ground stations and a recorder: what grows, drifts or falls behind?

    python tests/bench/soak_vehicle.py --minutes 30        real time, over loopback: MAVProxy, pymavlink, a recorder
    python tests/bench/soak_vehicle.py --sim-hours 8       vehicle time, as fast as it goes, in one process

Asserted at the end, exit status 1 if anything does not hold: memory is flat from the first tenth on, every stream that
was asked for comes at its rate within 2 %, the vehicle's clock keeps to the wall clock (real time only), and the
flight logs stay within their bound. Prints a line now and then and the figures at the end.
"""

from __future__ import annotations

import argparse
import gc
import resource
import socket
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(TESTS), str(TESTS.parent), str(TESTS / "clients")]

from bridge.connection import Connection  # noqa: E402
from bridge.messages import BY_NAME  # noqa: E402
from bridge.services import VehicleFiles  # noqa: E402
from bridge.tlog import TlogWriter  # noqa: E402

WANTED_HZ = {"ATTITUDE": 50.0, "LOCAL_POSITION_NED": 30.0, "HIGHRES_IMU": 50.0, "VFR_HUD": 10.0, "SYS_STATUS": 2.0}
"""Streams that a station asks for."""

RATE_SHARE = 0.02
DRIFT_S = 0.05
MOST_GROWTH_MB = 8.0
MOST_LOGS_MB = 1100.0
LINE_S = 60.0


class Station:
    """A ground station of our own on a port: heartbeats, asks for streams, counts what comes.

    Args:
        port: of the loopback. system: its own id. tlog: keeps all frames; None for a station that does not record.
    """

    def __init__(self, port: int, system: int, tlog: Path | None = None) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        self._socket.bind(("127.0.0.1", port))
        self._socket.settimeout(0.2)
        self.connection = Connection(system, 190, datagram=True)
        self._tlog = TlogWriter(tlog, epoch_us=0) if tlog else None
        self.counts: Counter[str] = Counter()
        self.first_boot_ms: int | None = None
        self.drifts_s: list[float] = []
        self._peer: tuple[str, int] | None = None
        self._since: tuple[float, int] | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def send(self, name: str, **fields: object) -> None:
        """Send a message once the vehicle has been heard."""
        if self._peer is not None:
            self._socket.sendto(self.connection.encode(name, **fields), self._peer)

    def command(self, number: int, *params: float) -> None:
        """Send a command to the vehicle."""
        fields = {f"param{k}": value for k, value in enumerate((*params, *[0.0] * 7)[:7], 1)}
        self.send("COMMAND_LONG", command=number, target_system=1, target_component=1, **fields)

    def _run(self) -> None:
        beat = 0.0
        while not self._stop.is_set():
            now = time.monotonic()
            if now >= beat:
                beat = now + 0.5
                self.send("HEARTBEAT", type=6, autopilot=8)
            try:
                data, self._peer = self._socket.recvfrom(65536)
            except TimeoutError:
                continue
            now = time.monotonic()
            for message in self.connection.receive(data):
                self.counts[message.name] += 1
                if message.name == "ATTITUDE":
                    if self._since is None:
                        self._since = now, message.time_boot_ms
                    self.drifts_s.append((message.time_boot_ms - self._since[1]) * 1e-3 - (now - self._since[0]))
                    del self.drifts_s[:-500]
            if self._tlog is not None:
                self._tlog.write(time.time_ns() // 1000, data)

    def close(self) -> None:
        """Stop and close the log."""
        self._stop.set()
        self._thread.join()
        self._socket.close()
        if self._tlog is not None:
            self._tlog.close()


def resident_mb(pid: int | str = "self") -> float:
    """Resident memory of a process."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def size_mb(folder: Path) -> float:
    """Of all files below a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6


def ask_streams(command: Callable[..., object]) -> None:
    """Ask for WANTED_HZ."""
    for name, rate_hz in WANTED_HZ.items():
        command(511, BY_NAME[name].id, 1e6 / rate_hz)


def real_time(minutes: float) -> list[str]:
    """Over loopback, in real time; returns what did not hold."""
    from mavproxy_console import Console
    from vehicle_process import VehicleProcess, free_port

    ports = [free_port() for _ in range(3)]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        links = [word for port in ports for word in ("--link", f"udpout://127.0.0.1:{port}#onboard")]
        station = Station(ports[0], 255)
        recorder = Station(ports[1], 250, folder / "all.tlog")
        vehicle = VehicleProcess(folder, 0, ["ant-x", *links, "--log-dir", str(folder / "logs")])
        pid = vehicle._process.pid
        try:
            with Console(ports[2], folder) as console:
                console.until(r"Received \d+ parameters", limit_s=60.0)
                for one in (station, recorder):
                    ask_streams(one.command)
                for _ in range(60):
                    station.command(400, 1.0)
                    station.command(22, 0.0, 0.0, 0.0, float("nan"), float("nan"), float("nan"), float("nan"))
                    time.sleep(1.0)
                    if "ARMED" in vehicle.printed() or console._text.count("ARMED"):
                        break
                time.sleep(10.0)
                begin, counts = time.monotonic(), [Counter(one.counts) for one in (station, recorder)]
                end, line, early = begin + 60.0 * minutes, begin + LINE_S, 0.0
                while (now := time.monotonic()) < end:
                    time.sleep(1.0)
                    if not early and now > begin + 6.0 * minutes:
                        early = resident_mb(pid)
                    if now > line:
                        line += LINE_S
                        drift_ms, logs_mb = station.drifts_s[-1] * 1e3, size_mb(folder / "logs")
                        print(
                            f"{(now - begin) / 60.0:5.1f} min  {resident_mb(pid):7.1f} MB  drift {drift_ms:+.1f} ms  "
                            f"logs {logs_mb:.1f} MB",
                            flush=True,
                        )
                took, late = time.monotonic() - begin, resident_mb(pid)
                rates = [
                    {name: (one.counts[name] - before[name]) / took for name in WANTED_HZ}
                    for one, before in zip((station, recorder), counts, strict=True)
                ]
        finally:
            station.close()
            recorder.close()
            last_words = vehicle.stop()
        drift_s = sum(station.drifts_s) / len(station.drifts_s)
        logs_mb, tlog_mb = size_mb(folder / "logs"), (folder / "all.tlog").stat().st_size / 1e6
        print(f"vehicle: {last_words}")
        print(
            f"memory {early:.1f} -> {late:.1f} MB, mean drift {drift_s * 1e3:+.1f} ms in {took / 60.0:.1f} min, "
            f"logs {logs_mb:.1f} MB, recorder's .tlog {tlog_mb:.1f} MB"
        )
        wrong = judged(early, late, rates, logs_mb)
    if abs(drift_s) > DRIFT_S:
        wrong.append(f"the vehicle's clock is {drift_s:+.3f} s off the wall clock after {took:.0f} s")
    return wrong


def vehicle_time(hours: float) -> list[str]:
    """In one process, as fast as it goes; returns what did not hold."""
    from hostile_vehicle import Watched

    with tempfile.TemporaryDirectory() as name:
        logs = Path(name)
        watched = Watched(modes=("gcs", "onboard", "onboard"), files=VehicleFiles(logs=logs))
        recorder = TlogWriter(logs.parent / f"{logs.name}.tlog")
        try:
            watched.run(20.0)
            for link in range(3):
                ask_streams(lambda number, *p, link=link: watched.command(number, *p, link=link))
            assert watched.command(400, 1.0) == 0, "it did not arm"
            watched.command(22, 0.0, 0.0, 0.0, *[float("nan")] * 4)
            watched.run(20.0)
            counts: list[Counter[str]] = [Counter() for _ in range(3)]
            tick_us, ticks = watched.vehicle.tick_us, round(hours * 3.6e9 / watched.vehicle.tick_us)
            early, line, begin = 0.0, time.monotonic() + LINE_S, time.monotonic()
            receivers = [Connection(240 - k, 190, datagram=True) for k in range(3)]
            for k in range(ticks):
                if k % 125 == 0:
                    for link in range(3):
                        watched.send("HEARTBEAT", link, type=6, autopilot=8)
                watched.server.step()
                for link, end in enumerate(watched.ends):
                    while (data := end.recv()) is not None:
                        counts[link].update(message.name for message in receivers[link].receive(data))
                        if link == 2:
                            recorder.write(k * tick_us, data)
                if k == ticks // 10:
                    gc.collect()
                    early = resident_mb()
                if time.monotonic() > line:
                    line += LINE_S
                    print(
                        f"{k * tick_us / 3.6e9:5.2f} h  {resident_mb():7.1f} MB  logs {size_mb(logs):.1f} MB",
                        flush=True,
                    )
            gc.collect()
            late, took = resident_mb(), time.monotonic() - begin
            flying = watched.vehicle.autopilot.armed
            rates = [{n: count[n] / (hours * 3600.0) for n in WANTED_HZ} for count in counts]
            print(
                f"{hours:g} h in {took:.0f} s ({hours * 3600.0 / took:.0f} x), memory {early:.1f} -> {late:.1f} MB, "
                f"logs {size_mb(logs):.1f} MB, recorder's .tlog {recorder.path.stat().st_size / 1e6:.0f} MB"
            )
            wrong = judged(early, late, rates, size_mb(logs))
            if not flying:
                wrong.append("it is not in the air any more")
        finally:
            recorder.close()
            recorder.path.unlink(missing_ok=True)
    return wrong


def judged(early_mb: float, late_mb: float, rates: list[dict[str, float]], logs_mb: float) -> list[str]:
    """What does not hold of memory, rates and logs."""
    wrong = []
    if late_mb - early_mb > MOST_GROWTH_MB:
        wrong.append(f"memory grew from {early_mb:.1f} to {late_mb:.1f} MB")
    for number, one in enumerate(rates):
        print(
            f"station {number}: "
            + ", ".join(f"{name} {rate:.2f} of {WANTED_HZ[name]:g} Hz" for name, rate in one.items())
        )
        for name, rate in one.items():
            if abs(rate / WANTED_HZ[name] - 1.0) > RATE_SHARE:
                wrong.append(f"station {number}: {name} at {rate:.2f} Hz, asked for {WANTED_HZ[name]:g}")
    if logs_mb > MOST_LOGS_MB:
        wrong.append(f"flight logs of {logs_mb:.0f} MB")
    return wrong


def main() -> int:
    """Run what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=0.0)
    parser.add_argument("--sim-hours", type=float, default=0.0)
    args = parser.parse_args()
    wrong = []
    if args.minutes:
        wrong += real_time(args.minutes)
    if args.sim_hours:
        wrong += vehicle_time(args.sim_hours)
    for one in wrong:
        print(f"DOES NOT HOLD: {one}")
    print("everything holds" if not wrong else f"{len(wrong)} findings")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
