import ctypes.util
import dataclasses
import math
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from scenarios.limits import Outcome
from scenarios.markdown import flight_page
from scenarios.one_flight import fly
from scenarios.recorder import FlightRecorder, cursor, viewer
from scenarios.recorder.blueprints import PALETTE, RANKS, candidate_colour, roll_range_deg
from scenarios.recorder.body import enu_quaternions, rotor_radius
from scenarios.recorder.comparison import best_flight, record_compare
from scenarios.recorder.flight_drawing import FlownVehicle
from scenarios.recorder.flight_plots import mode_name, roll_extremes, roll_room, saturation
from scenarios.recorder.flight_properties import flight_properties
from scenarios.recorder.screenshot import screenshot
from scenarios.recorder.spread import spreads
from sitl.actuators import RotorEffect, allocate, normalised_mix
from sitl.airframe import load_airframe
from sitl.errors import FileError

DEG = 180.0 / math.pi
VEHICLE = FlownVehicle(load_airframe("ant-x").rotors)


class Read:
    """What a recording holds, by entity: times in s, and the values of one component."""

    def __init__(self, path):
        import rerun as rr

        reader = rr.chunk.RrdReader(path)
        self.application_ids = {entry.application_id for entry in reader.recordings()}
        self.blueprints = len(reader.blueprints())
        self.chunks = {}
        for chunk in reader.stream():
            self.chunks.setdefault(chunk.entity_path, []).append((chunk.is_static, chunk.to_record_batch()))

    def column(self, entity, component):
        """(times, list of values) in order of time; times are empty for what holds always."""
        times, values = [], []
        for static, batch in self.chunks[entity]:
            if component not in batch.schema.names:
                continue
            values += batch.column(component).to_pylist()
            if not static:
                times += [t / 1e9 for t in batch.column("flight_time").cast("int64").to_pylist()]
        order = np.argsort(times, kind="stable")
        return np.array(times)[order], [values[n] for n in order] if len(order) else values

    def lines(self, entity):
        times, values = self.column(entity, "Scalars:scalars")
        return times, np.array(values)

    def text(self, entity):
        return self.column(entity, "TextDocument:text")[1][0][0]


def record(path, flight, **keys):
    recorder = FlightRecorder(
        path, name=flight.gain_set.name, recording_id=flight.gain_set.slug, vehicle=VEHICLE, **keys
    )
    rows = len(flight.telemetry)
    for first in range(0, rows, 250):
        recorder.append({name: values[first : first + 250] for name, values in flight.telemetry.columns.items()})
    for event in flight.events:
        recorder.event(event.t_s, event.severity, event.text)
    recorder.faults(7.0, "motor 2 out")
    recorder.faults(7.5, "")
    for segment in flight.segments:
        recorder.segment(segment)
    return recorder


@pytest.fixture(scope="module")
def flight(flown_run):
    return flown_run.flights[0]


@pytest.fixture(scope="module")
def recorded(flight, tmp_path_factory):
    path = tmp_path_factory.mktemp("flight") / "own_gains.rrd"
    assert record(path, flight).close(flight_page(flight), flight_properties(flight)) == path
    assert [file.name for file in path.parent.iterdir()] == ["own_gains.rrd"]
    return Read(path)


@pytest.fixture(scope="module")
def compared(flown_run, tmp_path_factory):
    return Read(record_compare(flown_run, tmp_path_factory.mktemp("run") / "compare.rrd"))


class TestFlight:
    def test_every_row_is_there_in_shown_units(self, recorded, flight):
        times, values = recorded.lines("/roll")
        assert np.allclose(times, flight.telemetry["t_s"], atol=1e-9)
        for line, column in enumerate(("phi_true_rad", "phi_sp_rad", "phi_rad")):
            assert np.allclose(values[:, line], flight.telemetry[column] * DEG, atol=1e-5, equal_nan=True)
        _, motors = recorded.lines("/motors")
        assert np.allclose(motors[:, 3], flight.telemetry["motor4"])
        _, position = recorded.lines("/position")
        assert np.allclose(position[:, 2], -flight.telemetry["down_m"]), "up, not down"

    @pytest.mark.parametrize("entity", ["/roll", "/roll_rate", "/delta_lat", "/motors", "/position"])
    def test_lines_carry_units_and_keep_their_peaks(self, recorded, entity):
        names = recorded.column(entity, "SeriesLines:names")[1][0]
        assert all("[" in name for name in names)
        assert len(names) == recorded.lines(entity)[1].shape[1]
        min_max = 5  # rerun's AggregationPolicy.MinMax
        assert recorded.column(entity, "SeriesLines:aggregation_policy")[1] == [[min_max]]

    def test_modes_and_segments_are_lanes(self, recorded):
        times, states = recorded.column("/state/mode", "StateChange:state")
        assert [state[0] for state in states] == ["Disarmed", "Takeoff", "Offboard", "Disarmed"]
        assert np.allclose(times, [4.0, 4.5, 5.0, 15.8], atol=1e-6)
        times, states = recorded.column("/state/manoeuvre", "StateChange:state")
        assert [(t, state[0]) for t, state in zip(times, states, strict=True)] == [
            (6.0, "step/1"),
            (8.0, "step/2"),
            (9.0, ""),
            (10.0, "track"),
            (15.0, ""),
        ]

    def test_faults_are_a_lane(self, recorded):
        times, states = recorded.column("/state/fault", "StateChange:state")
        assert [(t, state[0]) for t, state in zip(times, states, strict=True)] == [(7.0, "motor 2 out"), (7.5, "")]

    def test_events_have_levels(self, recorded):
        _, texts = recorded.column("/events", "TextLog:text")
        _, levels = recorded.column("/events", "TextLog:level")
        assert texts == [["Armed by external command"], ["Attitude failure (roll)"]]
        assert levels == [["INFO"], ["CRITICAL"]]

    def test_gains_metrics_and_verdict_are_properties(self, recorded, flight):
        assert recorded.column("/__properties/gains", "MC_ROLL_P")[1] == [[6.5]]
        assert recorded.column("/__properties/metrics", "rise_time_s")[1] == [[0.366]]
        assert recorded.column("/__properties/verdict", "telemetry_sha256")[1] == [[flight.telemetry_sha256]]

    def test_it_brings_its_layout_and_its_verdict(self, recorded):
        assert recorded.application_ids == {"froude"}
        assert recorded.blueprints >= 1
        assert recorded.text("/summary").startswith("# PASS: own gains")

    def test_the_body_is_where_the_vehicle_was(self, recorded, flight):
        _, places = recorded.column("/world/place", "Transform3D:translation")
        last = {name: float(flight.telemetry[name][-1]) for name in ("east_m", "north_m", "down_m")}
        assert np.allclose(places[-1][0], [last["east_m"], last["north_m"], -last["down_m"]], atol=1e-6)

    def test_terms_add_up_to_the_torque_of_the_motors(self, quick_job, tmp_path):
        job = quick_job(overrides={"gyro_noise_rad_s": 0.0, "gyro_quantum_rad_s": 0.0}, job={"folder": tmp_path})
        flown = fly(job)
        times, terms = Read(tmp_path / "set.rrd").lines("/roll_rate_terms")
        measured = flown.telemetry.between(flown.segments[0].start_s, flown.segments[-1].end_s - 0.002)
        rows = np.searchsorted(times, measured["t_s"] - 1e-6)
        assert np.allclose(times[rows], measured["t_s"], atol=1e-9)
        assert np.allclose(terms[rows, 4], measured["delta_lat"], atol=1e-6)
        assert np.allclose(terms[rows, :4].sum(axis=1), terms[rows, 4], atol=1e-12)
        assert np.ptp(terms[rows, 1]) > 0.01, "the integrator moves"

    def test_terms_with_noise_are_near_the_torque(self, quick_job, tmp_path):
        flown = fly(quick_job(job={"folder": tmp_path}))
        times, terms = Read(tmp_path / "set.rrd").lines("/roll_rate_terms")
        measured = flown.telemetry.between(flown.segments[0].start_s, flown.segments[-1].end_s - 0.002)
        rows = np.searchsorted(times, measured["t_s"] - 1e-6)
        assert np.std(terms[rows, 4] - measured["delta_lat"]) < 0.05 * np.std(measured["delta_lat"])

    def test_the_link_is_counted_and_told(self, quick_job, tmp_path):
        flown = fly(quick_job(job={"folder": tmp_path}))
        read = Read(tmp_path / "set.rrd")
        _, interval = read.lines("/link/interval")
        assert np.allclose(interval[1:, 0], 1e3 * np.diff(flown.telemetry["t_s"]), atol=1e-6)
        assert np.all(read.lines("/link/messages")[1] == 0)
        assert read.column("/__properties/link", "messages_lost")[1] == [[0]]
        assert read.column("/__properties/link", "telemetry_rate_hz")[1][0][0] == pytest.approx(250.0)
        assert read.column("/__properties/run", "vehicle")[1] == [["ant-x"]]
        assert read.text("/link_page").startswith("# Link")

    def test_margins_are_properties(self, recorded):
        assert recorded.column("/__properties/margins", "delay_margin_s")[1] == [[0.03]]
        assert len(recorded.chunks["/__properties/margins"]) == 1, "what is infinite is left out"


def test_saturation_is_told_by_the_motors_that_are_at_a_limit():
    time = np.arange(10) * 0.02
    motors = np.full((10, 2), 0.5)
    motors[2:4, 1] = 1.0
    motors[5, 0] = 0.0
    motors[9, 0] = 0.0
    assert saturation(time, motors) == [
        (0.0, ""),
        (0.04, "motor 1, 2 at a limit"),
        (pytest.approx(0.12), ""),
        (pytest.approx(0.18), "motor 1 at a limit"),
    ]
    assert saturation(time, np.full((10, 2), np.nan)) == [(0.0, "")]
    assert saturation(time[:0], motors[:0]) == []


@pytest.mark.parametrize("name", ["ant-x", "ant-r", "carrier-1", "adam-0"])
def test_rotors_are_drawn_apart(name):
    airframe = load_airframe(name)
    hubs = np.array([(r.px_m, -r.py_m, -r.pz_m) for r in airframe.rotors])
    radius = rotor_radius(hubs, airframe.diagonal_m)
    apart = [np.hypot(*(a - b)[:2]) for n, a in enumerate(hubs) for b in hubs[n + 1 :]]
    assert 0.0 < 2.0 * radius < min(apart)


class TestUnfinished:
    def test_an_abandoned_flight_keeps_what_was_flown(self, flight, tmp_path):
        path = tmp_path / "a.rrd"
        with pytest.raises(RuntimeError, match="link lost"), record(path, flight):
            raise RuntimeError("link lost")
        assert [file.name for file in tmp_path.iterdir()] == ["a.partial.rrd"]
        read = Read(tmp_path / "a.partial.rrd")
        assert len(read.lines("/roll")[0]) == len(flight.telemetry)
        assert read.blueprints == 1

    @pytest.mark.filterwarnings("ignore:RRD file has no footer")
    def test_a_killed_process_leaves_a_readable_file(self, tmp_path):
        program = f"""
import numpy as np, os, pathlib, threading
from scenarios.recorder import FlightRecorder, cursor, viewer
from scenarios.telemetry import Telemetry
from scenarios.recorder.flight_drawing import FlownVehicle
from sitl.airframe import load_airframe
recorder = FlightRecorder(pathlib.Path({str(tmp_path / "k.rrd")!r}), name="k", recording_id="k",
                          vehicle=FlownVehicle(load_airframe("ant-x").rotors))
for k in range(3):
    recorder.append(Telemetry.from_columns({{"t_s": k * 2.0 + np.arange(500) / 250.0}}).columns)
threading.Event().wait(1.0)
os._exit(9)
"""
        assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 9
        assert len(Read(tmp_path / "k.partial.rrd").lines("/roll")[0]) == 1500

    def test_nothing_flown_is_still_a_recording(self, flown_run, tmp_path):
        broken = flown_run.flights[2]
        record(tmp_path / "none.rrd", broken).close(flight_page(broken), flight_properties(broken))
        assert "arming refused" in Read(tmp_path / "none.rrd").text("/summary")

    def test_closing_twice_is_a_mistake_of_ours_abandoning_is_not(self, flight, tmp_path):
        recorder = record(tmp_path / "a.rrd", flight)
        recorder.close()
        recorder.abandon()
        with pytest.raises(ValueError, match="closed"):
            recorder.close()


class TestErrors:
    def test_a_folder_that_is_not_there(self, tmp_path):
        with pytest.raises(FileError, match=r"a\.rrd.*cannot be written.*--out"):
            FlightRecorder(tmp_path / "gone" / "a.rrd", name="a", recording_id="a", vehicle=VEHICLE)

    def test_a_full_disk_is_said_before_the_flight(self, tmp_path, monkeypatch):
        monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=1_000_000))
        with pytest.raises(FileError, match=r"1\.0 MB are free"):
            FlightRecorder(tmp_path / "a.rrd", name="a", recording_id="a", vehicle=VEHICLE)

    def test_a_disk_that_fills_up_in_flight_keeps_the_partial_file(self, flight, tmp_path, monkeypatch):
        recorder = record(tmp_path / "a.rrd", flight)

        def full(self, **_):
            raise RuntimeError("File-writer thread shut down prematurely")

        monkeypatch.setattr("rerun.RecordingStream.flush", full)
        with pytest.raises(FileError, match=r"a\.rrd: could not be finished.*a\.partial\.rrd"):
            recorder.close()
        assert not (tmp_path / "a.rrd").exists()
        assert (tmp_path / "a.partial.rrd").exists()


def renamed(flight, name):
    return dataclasses.replace(flight, gain_set=dataclasses.replace(flight.gain_set, name=name))


class TestCompare:
    def test_every_candidate_counts_from_its_manoeuvres_start(self, compared):
        times, values = compared.lines("/1_step/roll/00_setpoint")
        values = values.reshape(-1)
        assert np.all(values[times < -1e-6] == 0.0)
        assert values[np.searchsorted(times, -1e-6)] == pytest.approx(10.0, rel=1e-5)
        for entity in ("/1_step/roll/01_7_2_cycles", "/1_step/roll/02_own_gains"):
            candidate, _ = compared.lines(entity)
            assert np.allclose(candidate, times)

    def test_names_carry_the_verdict_and_the_best_is_drawn_last_and_widest(self, compared):
        names = [
            compared.column(f"/1_step/roll/{entity}", "SeriesLines:names")[1][0][0]
            for entity in ("01_7_2_cycles", "02_own_gains")
        ]
        assert names == ["7.2 cycles: FAIL [deg]", "own gains: PASS, best [deg]"]
        widths = [
            compared.column(f"/1_step/roll/{entity}", "SeriesLines:widths")[1][0][0]
            for entity in ("01_7_2_cycles", "02_own_gains")
        ]
        assert widths == [RANKS["oscillates"], RANKS["best"]]

    def test_the_band_is_five_per_cent_of_the_scored_step(self, compared):
        times, values = compared.lines("/1_step/roll/00_band_0")
        assert np.allclose(times, [0.0, 2.0])
        assert np.allclose(values, [[10.5, 9.5], [10.5, 9.5]])
        assert "/1_step/roll/00_band_1" not in compared.chunks, "a hold is not scored"

    def test_tracking_shows_the_error(self, compared, flown_run):
        times, error = compared.lines("/2_track/error/02_own_gains")
        rows = flown_run.flights[0].telemetry
        at = np.searchsorted(rows["t_s"], 10.0 + times[500] - 1e-6)
        assert error.reshape(-1)[500] == pytest.approx((rows["phi_sp_rad"][at] - rows["phi_rad"][at]) * DEG, abs=1e-4)

    def test_a_flight_that_was_broken_off_is_in_the_table_only(self, compared):
        assert not any("refused" in entity for entity in compared.chunks if not entity.startswith("/__prop"))
        assert "arming refused" in compared.text("/summary")
        assert compared.column("/__properties/refused_verdict", "outcome")[1] == [["FAIL"]]

    def test_the_winner_is_said_first_and_is_a_property(self, compared):
        assert compared.text("/summary").startswith("## Best: own gains")
        assert compared.column("/__properties/run", "best")[1] == [["own gains"]]
        assert compared.column("/__properties/run", "passed")[1] == [[1]]

    def test_more_sets_than_hues_leave_the_oscillating_ones_a_shared_name(self, flown_run, tmp_path):
        passes, cycles, _ = flown_run.flights
        flights = [passes, *(renamed(cycles, f"cycling {n}") for n in range(9))]
        read = Read(record_compare(dataclasses.replace(flown_run, flights=tuple(flights)), tmp_path / "c.rrd"))
        roll = [entity for entity in read.chunks if entity.startswith("/1_step/roll/") and "cycling" in entity]
        names = {read.column(entity, "SeriesLines:names")[1][0][0] for entity in roll}
        assert len(roll) == 9
        assert names == {"9 sets that oscillate: FAIL [deg]"}

    def test_the_spread_is_that_of_the_uncertain_model(self, quick_scenario, flown_run, tmp_path):
        scenario = quick_scenario()
        step = dataclasses.replace(flown_run.flights[0])
        found = spreads(scenario, [step])["step"]
        low, high = found.low_rad["own_gains"], found.high_rad["own_gains"]
        assert len(found.t_s) == len(low) == len(high)
        assert np.allclose(np.diff(found.t_s), 0.02)
        assert np.all(high >= low)
        assert np.degrees(low[95]) < np.degrees(high[95]) < 10.5, "near the set-point after 1.9 s"
        run = dataclasses.replace(flown_run, scenario=scenario)
        times, values = Read(record_compare(run, tmp_path / "c.rrd")).column(
            "/1_step/spread/02_own_gains", "Measurements:values"
        )
        assert np.allclose(times, found.t_s)
        assert np.allclose(np.ravel(values), np.degrees(0.5 * (low + high)))

    def test_no_spread_where_the_uncertainty_is_not_known(self, flown_run):
        assert spreads(flown_run.scenario, flown_run.flights) == {}, "no manoeuvres"

    def test_it_has_its_own_layout(self, compared):
        assert compared.application_ids == {"froude-compare"}
        assert compared.blueprints == 1

    def test_a_run_without_any_manoeuvre_is_still_a_page(self, flown_run, tmp_path):
        run = dataclasses.replace(flown_run, flights=flown_run.flights[2:])
        assert "arming refused" in Read(record_compare(run, tmp_path / "c.rrd")).text("/summary")

    def test_the_setpoint_is_that_of_the_flight_that_flew_it_longest(self, flown_run, tmp_path):
        short = flown_run.flights[1]
        short = dataclasses.replace(
            short, segments=short.segments[:1], telemetry=short.telemetry.between(4.0, 7.0), outcome=Outcome.FAIL
        )
        run = dataclasses.replace(flown_run, flights=(short, flown_run.flights[0]))
        read = Read(record_compare(run, tmp_path / "c.rrd"))
        assert read.lines("/1_step/roll/00_setpoint")[0][-1] == pytest.approx(3.0, abs=0.01)
        assert read.lines("/1_step/roll/01_7_2_cycles")[0][-1] == pytest.approx(1.0, abs=0.01)


def test_the_best_is_the_closest_of_those_that_pass(flown_run):
    passes, cycles, _ = flown_run.flights
    metrics = tuple(dataclasses.replace(m, value=0.9) if m.name == "rms_error_deg" else m for m in passes.metrics)
    closer = dataclasses.replace(passes, metrics=metrics)
    assert best_flight([passes, cycles, closer]) is closer
    assert best_flight([cycles]) is None


def test_candidates_keep_apart_and_failed_ones_step_back():
    assert len({candidate_colour(n, "passed") for n in range(len(PALETTE))}) == len(PALETTE)
    assert candidate_colour(0, "oscillates")[3] < candidate_colour(0, "failed")[3] == 255
    assert list(RANKS.values()) == sorted(RANKS.values())


def test_the_roll_axis_is_only_held_where_the_response_runs_away():
    asked = np.array([0.0, 10.0])
    assert roll_range_deg(asked, np.array([-1.0, 11.0]), spans=0.5) is None
    assert roll_range_deg(asked, np.array([-90.0, np.nan]), spans=0.5) == (-5.0, 15.0)
    assert roll_range_deg(np.zeros(2), np.array([-90.0, 90.0]), spans=0.5) is None
    assert roll_range_deg(np.zeros(0), np.zeros(0), spans=0.5) is None


def test_modes_have_px4s_names():
    assert [mode_name(state) for state in (14, 17, 4, -1, 99)] == [
        "Offboard",
        "Takeoff",
        "Hold",
        "Disarmed",
        "nav_state 99",
    ]


def rotation(quat):
    w, x, y, z = quat
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_the_body_points_in_east_north_up_where_it_points_in_north_east_down():
    rng = np.random.default_rng(3)
    phi, theta, psi = rng.uniform(-1.5, 1.5, (3, 50))
    ned_to_enu = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    flu_to_frd = np.diag([1, -1, -1])
    for quat, f, t, s in zip(enu_quaternions(phi, theta, psi), phi, theta, psi, strict=True):
        about_x = np.array([[1, 0, 0], [0, np.cos(f), -np.sin(f)], [0, np.sin(f), np.cos(f)]])
        about_y = np.array([[np.cos(t), 0, np.sin(t)], [0, 1, 0], [-np.sin(t), 0, np.cos(t)]])
        about_z = np.array([[np.cos(s), -np.sin(s), 0], [np.sin(s), np.cos(s), 0], [0, 0, 1]])
        expected = ned_to_enu @ about_z @ about_y @ about_x @ flu_to_frd
        assert np.allclose(rotation(quat), expected, atol=1e-12)


@pytest.mark.parametrize("name", ["ant-x", "ant-r", "carrier-1"])
@pytest.mark.parametrize("thrust", [0.15, 0.5, 0.8])
def test_roll_room_is_what_the_allocator_gives_at_most(name, thrust):
    rotors = load_airframe(name).rotors
    mix = normalised_mix([RotorEffect((r.px_m, r.py_m, r.pz_m), km=r.km) for r in rotors])
    most, least = roll_room(np.array([thrust]), roll_extremes(rotors))
    motors = np.zeros(len(rotors))
    for limit in (most[0], least[0]):
        for asked, exact in ((0.999 * limit, True), (1.3 * limit, False)):
            allocate(mix.columns, len(rotors), np.array([asked, 0.0, 0.0]), thrust, 1, 0, motors)
            given = float(mix.inverse[0] @ np.clip(motors, 0.0, 1.0))
            inside = np.all((motors >= -1e-9) & (motors <= 1.0 + 1e-9))
            if exact:
                assert inside
                assert given == pytest.approx(asked, abs=1e-9)
            else:
                assert abs(given) < abs(asked) - 1e-6


def test_importing_the_outputs_costs_nothing_heavy():
    program = (
        "import sys, scenarios.recorder, scenarios.recorder.comparison, scenarios.recorder.screenshot, "
        "scenarios.table, scenarios.markdown, scenarios.junit, scenarios.run_folder\n"
        "print(*sorted({'rerun', 'pyarrow', 'numba', 'rich', 'scipy', 'control', 'pandas'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


@pytest.mark.skipif(ctypes.util.find_library("vulkan") is None, reason="no Vulkan driver: the viewer cannot draw")
@pytest.mark.parametrize("tab", ["step", "track", "Vehicle, assumptions, gains"])
def test_the_viewer_draws_the_comparison_without_complaint(flown_run, tmp_path, tab):
    path = record_compare(flown_run, tmp_path / "compare.rrd")
    assert screenshot(path, tmp_path / "page.png", tab=tab) == []
    png = (tmp_path / "page.png").read_bytes()
    assert png.startswith(b"\x89PNG")
    assert png[16:24] == (1920).to_bytes(4, "big") + (1080).to_bytes(4, "big")


@pytest.mark.skipif(ctypes.util.find_library("vulkan") is None, reason="no Vulkan driver: the viewer cannot draw")
@pytest.mark.parametrize("tab", ["step", "track", "Whole flight", "3D", "Link"])
def test_the_viewer_draws_every_page_of_a_flight_without_complaint(flight, tmp_path, tab):
    record(tmp_path / "a.rrd", flight).close(flight_page(flight), flight_properties(flight), "# Link")
    assert screenshot(tmp_path / "a.rrd", tmp_path / "page.png", tab=tab) == []


@pytest.mark.skipif(ctypes.util.find_library("vulkan") is None, reason="no Vulkan driver: the viewer cannot draw")
def test_the_viewer_is_told_where_the_cursor_starts(flight, tmp_path):
    from rerun.experimental import ViewerClient

    path = record(tmp_path / "a.rrd", flight).close()
    assert cursor.first_moment(path) == (flight.gain_set.slug, pytest.approx(6.1))  # 0.1 s into the step
    port = viewer.free_port()
    with viewer.started("--headless", "--port", str(port), str(path)) as process:
        viewer.wait_until_listening(process, port)
        assert cursor.put_when_loaded(path, port)
        (state,) = ViewerClient(f"rerun+http://{viewer.HOST}:{port}/proxy").get_state().recordings
        assert state.current_time * 1e-9 == pytest.approx(cursor.first_moment(path)[1], abs=1e-3)


def test_of_one_gain_set_nothing_is_best(flown_run, tmp_path):
    run = dataclasses.replace(flown_run, flights=flown_run.flights[:1])
    one = Read(record_compare(run, tmp_path / "compare.rrd"))
    assert one.text("/summary").startswith("## own gains: PASS\n")
    names = [one.column(entity, "SeriesLines:names")[1][0][0] for entity in one.chunks if "/roll/" in entity]
    assert names
    assert not any("best" in name for name in names)


def test_no_manoeuvre_no_cursor(tmp_path):
    (tmp_path / "damaged.rrd").write_bytes(b"RRF2" + b"\xff" * 500)
    for name in ("damaged.rrd", "none.rrd"):
        assert cursor.first_moment(tmp_path / name) is None
        assert not cursor.put_when_loaded(tmp_path / name)


def test_a_screenshot_of_nothing_is_an_error_that_names_it(tmp_path):
    with pytest.raises(FileError, match=r"none\.rrd: no such recording"):
        screenshot(tmp_path / "none.rrd", tmp_path / "x.png")
