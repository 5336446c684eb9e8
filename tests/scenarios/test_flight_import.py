"""Recorded flights of our own vehicle, whose telemetry is known: the same steps are found, and the same metrics."""

from __future__ import annotations

import dataclasses
import re
import struct
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from bridge.connection import Connection
from bridge.flight_log import FlightLog as UlogWriter
from bridge.vehicle_server import ServerLink, VehicleServer
from scenarios import cli, one_flight
from scenarios.flight import FlightRecord, RunRecord
from scenarios.flight_import.command import ImportOptions, import_flights
from scenarios.flight_import.loop_parameters import groups
from scenarios.flight_import.recorded import Change
from scenarios.flight_import.step_finder import find
from scenarios.flight_import.tlog_source import read_tlog
from scenarios.flight_import.ulog_source import read_ulog
from scenarios.limits import Outcome
from scenarios.manoeuvres import make_manoeuvre
from scenarios.one_flight import FlightJob, fly
from scenarios.run_reader import read_run
from scenarios.twin import OWN_SUFFIX
from sitl.modes import Mode, Result
from sitl.setpoints import Sticks

SETTLES_S = 0.025
"""A log shows a step's set-point a tick after it was sent, and at most one of its own periods after that."""


@dataclasses.dataclass(frozen=True)
class Flown:
    """A flight and what it left: PX4-like ULogs by profile, and the .tlog."""

    record: FlightRecord
    ulog: Path
    tlog: Path


def fly_logged(job: FlightJob, folder: Path, profile: int) -> Flown:
    """Fly a job with the vehicle's own flight log running, as `froude sitl` has it."""
    logs: list[UlogWriter] = []

    class Server(VehicleServer):
        def __init__(self, vehicle: Any, links: list[ServerLink]) -> None:
            super().__init__(vehicle, links)
            vehicle.parameters.set("SDLOG_PROFILE", profile)
            logs.append(UlogWriter(folder / "ulog", vehicle))

        def step(self) -> None:
            super().step()
            logs[0].tick()

    (folder / "flights").mkdir(parents=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(one_flight, "VehicleServer", Server)
        record = fly(dataclasses.replace(job, folder=folder / "flights"))
    logs[0].close()
    (ulog,) = folder.rglob("*.ulg")
    return Flown(record, ulog, folder / "flights" / f"{job.slug}.tlog")


@pytest.fixture(scope="module")
def steps(quick_job: Any, tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """A step of 10 degrees, logged at every tick."""
    return fly_logged(quick_job(), tmp_path_factory.mktemp("steps"), 17)


@pytest.fixture(scope="module")
def tracking(quick_job: Any, tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """Two steps' worth of a doublet and a tracking signal, logged as PX4 does by default."""
    doublet = make_manoeuvre("doublet", amplitude_deg=8.0, hold_s=2.5)
    job = quick_job(manoeuvres=(doublet, make_manoeuvre("track")))
    return fly_logged(job, tmp_path_factory.mktemp("tracking"), 1)


def value(flight: FlightRecord, name: str, segment: str = "") -> float | None:
    metric = flight.metric(name, segment)
    assert metric is not None, name
    return metric.value


@cache
def imported_run(path: Path, **options: Any) -> RunRecord:
    return import_flights([path], ImportOptions(out=None, **options)).run


def imported(path: Path, **options: Any) -> FlightRecord:
    (flight,) = imported_run(path, **options).flights
    return flight


@pytest.mark.parametrize("kind", ["ulog", "tlog"])
def test_the_steps_flown_are_the_steps_found(steps: Flown, kind: str) -> None:
    flight = imported(getattr(steps, kind))
    flown = list(steps.record.segments)
    assert [one.kind for one in flight.segments] == [one.kind for one in flown] == ["step", "hold"]
    for found, one in zip(flight.segments, flown, strict=True):
        assert 0.0 <= found.start_s - one.start_s <= 0.012
        assert found.amplitude_rad == pytest.approx(one.amplitude_rad, abs=1e-4)
        assert found.phi_from_rad == pytest.approx(one.phi_from_rad, abs=1e-4)


@pytest.mark.parametrize("kind", ["ulog", "tlog"])
def test_the_metrics_are_those_of_the_flight_itself(steps: Flown, kind: str) -> None:
    flight = imported(getattr(steps, kind), vehicle="ant-x", limits="practical")
    for name, within in {
        "overshoot_pct": 0.2,
        "rise_time_s": 0.004,
        "droop_deg": 0.05,
        "peak_delta_lat": 0.01,
        "oscillation_rad_s": 0.005,
        "attitude_rate_hz": 2.0,
        "delay_margin_s": 1e-9,
    }.items():
        assert value(flight, name) == pytest.approx(value(steps.record, name), abs=within), name
    settled, known = (value(one, "settling_time_5pct_s") for one in (flight, steps.record))
    assert (settled is None) is (known is None)
    assert settled is None or settled == pytest.approx(known, abs=SETTLES_S)
    assert flight.outcome is steps.record.outcome is Outcome.PASS


def test_a_log_of_px4s_default_rates_gives_the_same_within_its_period(tracking: Flown) -> None:
    flight = imported(tracking.ulog)
    kinds = [one.kind for one in flight.segments]
    assert kinds == ["step", "hold", "hold", "hold", "track", "hold"]
    for found, one in zip(flight.segments[:4], tracking.record.segments[:4], strict=True):
        assert 0.0 <= found.start_s - one.start_s <= 0.025
    first = tracking.record.segments[0].name
    for name, within in {"overshoot_pct": 0.5, "rise_time_s": 0.012, "droop_deg": 0.1}.items():
        found = value(flight, name, flight.segments[0].name)
        assert found == pytest.approx(value(tracking.record, name, first), abs=within), name
    # straight lines between 20 set-points a second lead what was sent fifty times and held, by half of its period
    assert value(flight, "vaf_pct") == pytest.approx(value(tracking.record, "vaf_pct"), abs=3.0)
    assert value(flight, "lag_s") == pytest.approx(value(tracking.record, "lag_s"), abs=0.015)
    assert any("delta_lat is the torque set-point" in text for text in flight.warnings)


def test_gains_geometry_and_filters_come_from_the_log(steps: Flown) -> None:
    recorded = read_ulog(steps.ulog)
    assert len({(one.px_m, one.py_m) for one in recorded.rotors}) == 4
    gains = imported(steps.ulog).gain_set.parameters
    flown = steps.record.parameters
    assert {name: gains[name] for name in flown if name in gains} == {n: flown[n] for n in flown if n in gains}
    assert gains["MC_ROLLRATE_P"] == flown["MC_ROLLRATE_P"]
    assert gains["IMU_GYRO_CUTOFF"] == 40.0


def test_without_a_vehicle_nothing_is_guessed(steps: Flown) -> None:
    run = imported_run(steps.tlog)
    (flight,) = run.flights
    assert not flight.margins
    assert run.twins == ()
    assert not run.vehicle["derivatives"]
    assert flight.outcome is Outcome.INFO
    assert value(flight, "peak_delta_lat") is None
    assert any("CA_ROTOR" in text for text in flight.warnings)


def test_the_flight_beside_it_is_the_flight_again(steps: Flown) -> None:
    (twin,) = imported_run(steps.ulog, vehicle="ant-x", limits="practical").twins
    assert twin.difference.agree
    roll = twin.difference.quantity("roll_difference_deg")
    assert roll is not None
    assert roll.difference is not None
    assert roll.difference < 0.5
    assert {one.name for one in twin.own.segments} == {one.name for one in twin.flight.segments}


def test_gains_that_were_changed_between_steps_make_two_candidates(steps: Flown, tmp_path: Path) -> None:
    """The same flight twice in a row, the second time with another P: as whoever tunes in flight would leave it."""
    recorded = read_ulog(steps.ulog)
    found = find(recorded)
    segments = [*found.segments, dataclasses.replace(found.segments[0], name="later", manoeuvre="later")]
    changed = Change(found.segments[1].end_s, "MC_ROLLRATE_P", 0.07)
    tuned = dataclasses.replace(recorded, changes=(*recorded.changes, changed))
    begins = {**found.begins, "later": changed.t_s + 1.0}
    first, second = groups(tuned, dataclasses.replace(found, begins=begins), segments)
    assert [one.name for one in first.segments] == [one.name for one in found.segments]
    assert [one.name for one in second.segments] == ["later"]
    assert first.gain_set.parameters["MC_ROLLRATE_P"] != second.gain_set.parameters["MC_ROLLRATE_P"] == 0.07
    assert first.gain_set.slug != second.gain_set.slug


def test_a_run_folder_like_any_other(steps: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [str(steps.ulog), str(steps.tlog), "--vehicle", "ant-x", "--limits", "practical", "--out", str(tmp_path)]
    assert cli.main(["review", *words, "--gate"]) == cli.EXIT_OK
    printed = capsys.readouterr().out
    assert "The recorded flight beside our own autopilot on the model" in printed
    (folder,) = tmp_path.iterdir()
    run = read_run(folder)
    assert not run.problems
    assert len(run.flights) == 2
    slugs = [one.slug for one in run.flights]
    for slug in slugs:
        for suffix in (".parquet", ".rrd", ".params", f"{OWN_SUFFIX}.rrd"):
            assert (folder / "flights" / f"{slug}{suffix}").is_file(), (slug, suffix)
    assert (folder / "compare.rrd").is_file()
    assert (folder / "junit.xml").is_file()
    assert cli.main(["review", "--list", "--out", str(tmp_path)]) == cli.EXIT_OK


def test_too_little_excitation_is_refused_with_numbers(quick_job: Any, tmp_path: Path) -> None:
    gentle = make_manoeuvre("step", amplitude_deg=1.2, hold_s=2.0, return_s=2.0)
    flown = fly_logged(quick_job(manoeuvres=(gentle,)), tmp_path / "gentle", 17)
    for path in (flown.ulog, flown.tlog):
        assert cli.main(["review", str(path), "--out", str(tmp_path / "runs")]) == cli.EXIT_USAGE
    assert not (tmp_path / "runs").exists()
    with pytest.raises(Exception, match=r"largest step in roll 1\.2 deg over the flight; 3 deg are needed"):
        imported(flown.ulog)


# -- by sticks ---------------------------------------------------------------------------------------------------------


def test_steps_of_sticks_quick_and_rate_limited(flight: Any, tmp_path: Path) -> None:
    """A pilot's steps in Stabilized and in Altitude; the second one's stick takes 150 ms to its place."""
    flown = flight("ant-x")
    flown.parameters.set("SDLOG_PROFILE", 17)
    log = UlogWriter(tmp_path, flown.vehicle)
    stick = [0.0]

    def each(k: int) -> None:
        log.tick()
        if not k % 5:
            flown.autopilot.manual.take(flown.vehicle.time_us, 0, Sticks(roll=stick[0]))

    flown.take_off(settle_s=1.0)
    begun = []
    for mode, ramp_ticks in ((Mode.STABILIZED, 1), (Mode.ALTCTL, 37)):
        flown.autopilot.manual.take(flown.vehicle.time_us, 0, Sticks())
        assert flown.autopilot.command_mode(mode) is Result.ACCEPTED
        flown.run(1.0, each)
        begun.append(flown.time_s)
        for k in range(ramp_ticks):
            stick[0] = 0.3 * (k + 1) / ramp_ticks
            flown.run(0.004, each)
        flown.run(2.5, each)
        stick[0] = 0.0
        flown.run(2.5, each)
        assert flown.autopilot.command_mode(Mode.LOITER) is Result.ACCEPTED
        flown.run(6.0, each)
    log.close()
    (path,) = tmp_path.rglob("*.ulg")
    found = find(read_ulog(path))
    assert [one.kind for one in found.segments] == ["step", "hold", "step", "hold"]
    quick, _, slewed, _ = found.segments
    assert quick.start_s == pytest.approx(begun[0], abs=0.03)
    assert slewed.start_s == pytest.approx(begun[1] + 0.075, abs=0.04)
    (note,) = found.notes
    assert re.search(r"step_2/1: the set-point took 1[0-9]{2} ms, less than the vehicle's rise", note)


# -- several systems, MAVLink 1, restarts ------------------------------------------------------------------------------


def frames(path: Path) -> list[tuple[bytes, bytes]]:
    """(stamp, frame) of a .tlog of our own, MAVLink 2 without signatures."""
    data, found, at = path.read_bytes(), [], 0
    while at < len(data):
        size = 12 + data[at + 9]
        found.append((data[at : at + 8], data[at + 8 : at + 8 + size]))
        at += 8 + size
    return found


def as_mavlink_1(frame: bytes) -> bytes:
    """The same message in the older framing; one that has no such form is left out."""
    (message,) = Connection(1, 1).receive(frame)
    if message.id > 255:
        return b""
    from bridge.framing import crc16
    from bridge.messages import BY_ID

    kind = BY_ID[message.id]
    short = {"ATTITUDE": 28, "ATTITUDE_TARGET": 37, "HEARTBEAT": 9, "LOCAL_POSITION_NED": 28, "PARAM_VALUE": 25}
    size = short.get(kind.name)
    if size is None:
        return b""
    payload = frame[10:-2].ljust(size, b"\0")[:size]
    body = struct.pack("<5B", size, frame[4], frame[5], frame[6], message.id) + payload
    return b"\xfe" + body + crc16(body + kind.crc_extra).to_bytes(2, "little")


def test_mavlink_1_says_the_same(steps: Flown, tmp_path: Path) -> None:
    old = tmp_path / "old.tlog"
    old.write_bytes(b"".join(stamp + one for stamp, frame in frames(steps.tlog) if (one := as_mavlink_1(frame))))
    a, b = imported(steps.tlog), imported(old)
    assert value(a, "overshoot_pct") == value(b, "overshoot_pct")
    assert a.gain_set.parameters == b.gain_set.parameters


def renumbered(frame: bytes, system: int) -> bytes:
    from bridge.framing import crc16
    from bridge.messages import BY_ID

    body = frame[1:5] + bytes([system]) + frame[6:-2]
    kind = BY_ID[int.from_bytes(frame[7:10], "little")]
    return frame[:1] + body + crc16(body + kind.crc_extra).to_bytes(2, "little")


def test_of_several_systems_that_flew_one_must_be_named(steps: Flown, tmp_path: Path) -> None:
    both = tmp_path / "both.tlog"
    twice = [
        stamp + one
        for stamp, frame in frames(steps.tlog)
        for one in (frame, renumbered(frame, 7))
        if frame[5] == 1 or one is frame
    ]
    both.write_bytes(b"".join(twice))
    with pytest.raises(Exception, match=r"systems 1, 7 all flew in it\. Say which is meant: --system 1"):
        read_tlog(both)
    assert len(read_tlog(both, system=7).telemetry) == len(read_tlog(steps.tlog).telemetry)
    with pytest.raises(Exception, match=r"--system 3: no autopilot of that number; there is 1, 7"):
        read_tlog(both, system=3)


def test_a_restart_in_the_log_is_another_flight(steps: Flown, tmp_path: Path) -> None:
    again = tmp_path / "again.tlog"
    data = b"".join(stamp + frame for stamp, frame in frames(steps.tlog))
    again.write_bytes(data + data[: len(data) // 2])
    flight = imported(again)
    assert any("time went backwards 1 times" in text for text in flight.warnings)
    assert [one.kind for one in flight.segments] == ["step", "hold"]


def test_a_gap_in_the_attitude_stays_one(steps: Flown, tmp_path: Path) -> None:
    begin = steps.record.segments[0].start_s + 0.5
    holed = tmp_path / "holed.tlog"

    def kept(frame: bytes) -> bool:
        if frame[7:10] != b"\x1e\0\0":
            return True
        t_s = 1e-3 * int.from_bytes(frame[10:14], "little")
        return not begin < t_s < begin + 0.4

    holed.write_bytes(b"".join(stamp + frame for stamp, frame in frames(steps.tlog) if kept(frame)))
    recorded = read_tlog(holed)
    assert len(recorded.telemetry.between(begin + 0.01, begin + 0.39)) == 0
    assert find(recorded).segments[0].kind == "step"
    with pytest.raises(Exception, match=r"a gap of 0\.40 s in the attitude"):
        imported(holed)
