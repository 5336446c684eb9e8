"""One gain set in the air: what it may do to the vehicle, and what the harness owes to it."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bridge.errors import AlreadyArmed, PeerLost, UploadFailed
from bridge.link import LossyLink, MemoryLink
from bridge.tlog import TlogWriter
from scenarios import one_flight
from scenarios.flight import FlightRecord
from scenarios.limits import Outcome
from scenarios.manoeuvres import make_manoeuvre
from scenarios.one_flight import FlightJob, FlightStoppedError, fly
from sitl.errors import FileError
from sitl.parameters import ParameterTable
from sitl.vehicle import Vehicle

AIRFRAMES = ("ant-x", "ant-r", "carrier-1", "adam-0")
OWN = {"MC_ROLL_P": 6.5, "MC_ROLLRATE_P": 0.05, "MC_ROLLRATE_I": 0.05, "MC_ROLLRATE_D": 0.001}
CYCLES = {"MC_ROLL_P": 12.04, "MC_ROLLRATE_P": 0.6, "MC_ROLLRATE_I": 35.8, "MC_ROLLRATE_D": 0.0}


@pytest.fixture
def vehicles(monkeypatch: pytest.MonkeyPatch) -> list[Vehicle]:
    """The vehicles that `fly` makes for itself."""
    made: list[Vehicle] = []

    def make(*args: Any, **keys: Any) -> Vehicle:
        made.append(Vehicle(*args, **keys))
        made[-1].parameters_before = _values(made[-1].parameters)  # type: ignore[attr-defined]
        return made[-1]

    monkeypatch.setattr(one_flight, "Vehicle", make)
    return made


def _values(table: ParameterTable) -> dict[str, bytes]:
    return {name: table.raw(name) for name in table.names}


def left_as_found(vehicle: Any) -> bool:
    """On the ground, disarmed, every parameter as it was."""
    return not vehicle.autopilot.armed and _values(vehicle.parameters) == vehicle.parameters_before


def flies(record: FlightRecord) -> bool:
    oscillation = record.metric("oscillation_rad_s")
    segments = len(record.segments) == 2
    return segments and oscillation is not None and oscillation.value is not None and oscillation.value < 0.1


class TestTheGainsThatFlewFly:
    @pytest.mark.parametrize("vehicle", AIRFRAMES)
    def test_at_any_hover_thrust(self, quick_job: Any, vehicle: str) -> None:
        for hover in (0.2, 0.35, 0.65, 0.8):
            assert flies(fly(quick_job(vehicle=vehicle, assumptions={"hover_thrust": hover}))), hover

    @pytest.mark.parametrize("vehicle", AIRFRAMES)
    def test_at_any_motor_lag(self, quick_job: Any, vehicle: str) -> None:
        for lag_s in (0.0, 0.010, 0.050):
            assert flies(fly(quick_job(vehicle=vehicle, overrides={"motor_lag_s": lag_s}))), lag_s

    @pytest.mark.parametrize("profile", ["study", "board"])
    def test_in_the_other_profiles(self, quick_job: Any, profile: str) -> None:
        assert flies(fly(quick_job(profile=profile)))

    @pytest.mark.parametrize("amplitude_deg", [45.0, -45.0, 1.0])
    def test_through_steps_large_and_small(self, quick_job: Any, amplitude_deg: float) -> None:
        step = make_manoeuvre("step", amplitude_deg=amplitude_deg, hold_s=2.0, return_s=2.0)
        record = fly(quick_job(manoeuvres=(step,)))
        assert flies(record)
        assert record.outcome is Outcome.PASS

    @pytest.mark.parametrize("rate_hz", [5.0, 250.0])
    def test_at_any_set_point_rate(self, quick_job: Any, rate_hz: float) -> None:
        assert flies(fly(quick_job(setpoint_rate_hz=rate_hz)))

    def test_from_the_lowest_height(self, quick_job: Any) -> None:
        assert flies(fly(quick_job(takeoff_altitude_m=2.0)))


class TestAirframesOfTheUser:
    @pytest.mark.parametrize(
        ("layout", "rotors"),
        [("custom", 6), ("octo", 8), ("X8", 8), ("custom", 12)],
    )
    def test_with_other_rotors(self, quick_job: Any, tmp_path: Path, layout: str, rotors: int) -> None:
        path = airframe_file(tmp_path, layout, rotors)
        (tmp_path / "flights").mkdir()
        record = fly(quick_job(OWN, vehicle=str(path), job={"folder": tmp_path / "flights"}))
        assert flies(record)
        assert record.outcome is Outcome.PASS
        # the same normalised torque flies the same step, whatever makes it
        square = fly(quick_job(OWN, vehicle=str(airframe_file(tmp_path, "X", 4))))
        rise, same = record.metric("rise_time_s"), square.metric("rise_time_s")
        assert rise is not None
        assert same is not None
        assert rise.value == pytest.approx(same.value, abs=0.002)
        assert (tmp_path / "flights" / "set.rrd").is_file()

    def test_without_flight_gains_pitch_flies_px4s_defaults_and_that_is_said(
        self, quick_job: Any, tmp_path: Path
    ) -> None:
        record = fly(quick_job(OWN, vehicle=str(airframe_file(tmp_path, "X", 4))))
        assert record.warnings == ("MINE has no flight gains of its own: pitch flies PX4's defaults",)
        assert "MC_PITCH_P" not in record.parameters


def airframe_file(folder: Path, layout: str, rotors: int) -> Path:
    """ANT-X's model on arms all around, every other rotor turning the other way; X8: two on each of four arms."""
    arms = rotors // 2 if layout == "X8" else rotors
    lines = [
        'name = "MINE"\nmass_kg = 0.3\nframe_m = [0.2, 0.2, 0.04]\ndiagonal_m = 0.2\nlateral_m = 0.15',
        f'layout = "{layout}"',
        "[derivatives]\nYv_1_s = -0.1068\nYp_m_s_rad = 0.1192\nYd_m_s2 = -10.1647",
        "Lv_rad_m_s = -5.9755\nLp_1_s = -2.6478\nLd_rad_s2 = 450.71",
    ]
    for n in range(rotors):
        arm = n % arms
        angle = 2 * np.pi * (arm + 0.5) / arms
        turns = 1 if (arm + n // arms) % 2 == 0 else -1
        lines.append(f"[[rotors]]\npx_m = {0.1 * np.cos(angle)}\npy_m = {0.1 * np.sin(angle)}\nkm = {0.05 * turns}")
    path = folder / f"{layout}{rotors}.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


class TestStrangeSets:
    """A set may do anything; the result says what it did, and the vehicle is left as it was."""

    @pytest.mark.parametrize(
        ("gains", "outcome", "reason"),
        [
            (CYCLES, Outcome.FAIL, "limit cycle 8.*Hz.* rad/s in roll"),
            ({**OWN, "MC_ROLLRATE_I": 47.0}, Outcome.FAIL, "limit cycle"),
            ({**OWN, "MC_ROLLRATE_P": 5.0}, Outcome.FAIL, "take-off failed: .* m of 3 m reached in 60 s"),
            (dict.fromkeys(OWN, 0.0), Outcome.UNSET, "rise time unset: never reaches 90 %"),
            ({**OWN, "IMU_GYRO_CUTOFF": 0.0}, Outcome.PASS, "^$"),
            ({**OWN, "IMU_DGYRO_CUTOFF": 0.0}, Outcome.PASS, "^$"),
            ({**OWN, "IMU_GYRO_CUTOFF": 0.01}, Outcome.FAIL, "diverged: tilt beyond 80 deg"),
            ({**OWN, **{f"CA_ROTOR{n}_PX": x for n, x in enumerate((0.5, -0.5, 0.5, -0.5))}}, Outcome.PASS, "^$"),
            ({**OWN, **{f"CA_ROTOR{n}_PY": y for n, y in enumerate((-0.1, 0.1, 0.1, -0.1))}}, Outcome.FAIL, "diverged"),
            ({**OWN, "CA_ROTOR_COUNT": 0}, Outcome.FAIL, "arm: temporarily rejected .* rotor geometry"),
            ({**OWN, "CA_ROTOR_COUNT": 1}, Outcome.FAIL, "diverged|take-off failed"),
            ({**OWN, "MPC_THR_HOVER": 0.1}, Outcome.FAIL, "take-off failed"),
            ({**OWN, "COM_OF_LOSS_T": 0.0}, Outcome.FAIL, "mode Offboard: temporarily rejected"),
            ({**OWN, "MPC_LAND_SPEED": 0.0}, Outcome.FAIL, "did not land and disarm within 90 s"),
        ],
        ids=lambda value: None if isinstance(value, Outcome) else str(value)[:40],
    )
    def test_in_roll(
        self, quick_job: Any, vehicles: Any, gains: dict[str, float | int], outcome: Outcome, reason: str
    ) -> None:
        record = fly(quick_job(gains))
        assert record.outcome is outcome
        assert re.search(reason, record.reason), record.reason
        assert left_as_found(vehicles[0])

    def test_on_both_axes_a_set_that_turns_the_vehicle_over(self, quick_job: Any, vehicles: Any) -> None:
        record = fly(quick_job(CYCLES, vehicle="ant-r", axes="both", takeoff_altitude_m=10.0))
        assert record.outcome is Outcome.FAIL
        assert left_as_found(vehicles[0])

    def test_the_delta_of_changed_geometry_is_that_of_the_changed_mix(self, quick_job: Any) -> None:
        """A mix of other proportions: delta_lat is what the allocator was asked for, in its own terms."""
        wide = {f"CA_ROTOR{n}_PY": y for n, y in enumerate((0.3, -0.1, -0.3, 0.1))}
        plain, changed = fly(quick_job(OWN)), fly(quick_job({**OWN, **wide}))
        peak, other = plain.metric("rms_delta_lat"), changed.metric("rms_delta_lat")
        assert peak is not None
        assert other is not None
        assert other.value != pytest.approx(peak.value, rel=0.01)


class TestTheVehicleIsGivenBack:
    def test_after_a_flight(self, quick_job: Any, vehicles: Any) -> None:
        fly(quick_job({**OWN, "MC_AIRMODE": 1}))
        assert left_as_found(vehicles[0])

    @pytest.mark.parametrize("phase", ["upload", "take off", "step", "land", "restore"])
    def test_after_ctrl_c(self, quick_job: Any, vehicles: Any, phase: str) -> None:
        """In the flight the vehicle is landed first; a second Ctrl-C, in the landing, leaves it as it is."""

        def progress(now: str) -> None:
            if now == phase:
                raise KeyboardInterrupt

        with pytest.raises(FlightStoppedError) as stop:
            fly(quick_job(OWN), progress)
        assert isinstance(stop.value.cause, KeyboardInterrupt)
        record = stop.value.record
        assert record.outcome is Outcome.UNSET
        assert record.reason.startswith("interrupted")
        assert len(record.telemetry)
        assert record.events[-1].text == "flight stopped: interrupted"
        assert left_as_found(vehicles[0]) is (phase in ("upload", "take off", "step"))

    def test_after_a_refusal_in_the_middle_of_the_upload(
        self, quick_job: Any, vehicles: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Nothing flies with half a gain set."""
        store = ParameterTable.set_raw
        refused = []

        def set_raw(table: ParameterTable, name: str, raw: bytes) -> Any:
            if name == "MC_ROLLRATE_I" and raw != table.raw(name) and len(refused) < 30:
                refused.append(name)
                return None
            return store(table, name, raw)

        monkeypatch.setattr(ParameterTable, "set_raw", set_raw)
        with pytest.raises(FlightStoppedError) as stop:
            fly(quick_job(OWN))
        assert refused
        assert isinstance(stop.value.cause, UploadFailed)
        assert "MC_ROLLRATE_I = 0.05 was not taken: the vehicle keeps 0.2" in str(stop.value.cause)
        assert not any("Armed" in event.text for event in stop.value.record.events)
        assert left_as_found(vehicles[0])

    @pytest.mark.parametrize("seed", range(3))
    def test_over_a_link_that_loses_three_in_ten(
        self, quick_job: Any, vehicles: Any, monkeypatch: pytest.MonkeyPatch, seed: int
    ) -> None:
        class Lossy(MemoryLink):
            @classmethod
            def pair(cls, limit: int = 10_000) -> Any:
                near, far = MemoryLink.pair(limit)
                return LossyLink(near, np.random.default_rng(seed), loss=0.3), far

        monkeypatch.setattr(one_flight, "MemoryLink", Lossy)
        record = fly(quick_job())
        assert record.outcome is Outcome.PASS, record.reason
        assert left_as_found(vehicles[0])

    def test_one_that_somebody_flies_is_not_touched(
        self, quick_job: Any, vehicles: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        wait_ready = one_flight.Client.wait_ready

        def armed_by_somebody(client: Any, timeout_s: float) -> None:
            wait_ready(client, timeout_s)
            assert vehicles[0].autopilot.command_arm(True).name == "ACCEPTED"
            client.wait(1.5)

        monkeypatch.setattr(one_flight.Client, "wait_ready", armed_by_somebody)
        with pytest.raises(FlightStoppedError) as stop:
            fly(quick_job())
        assert isinstance(stop.value.cause, AlreadyArmed)
        assert "the vehicle is armed already. Land and disarm it" in str(stop.value.cause)
        assert vehicles[0].autopilot.armed
        assert _values(vehicles[0].parameters) == vehicles[0].parameters_before

    def test_a_vehicle_that_went_away_is_told_with_what_is_left_to_do(
        self, quick_job: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, state_dir: Path
    ) -> None:
        """The vehicle is another's here: only such a one has to be given back."""
        job = quick_job(job={"folder": tmp_path})
        monkeypatch.setattr(FlightJob, "in_memory", property(lambda self: False))
        monkeypatch.setattr(one_flight._Flight, "_open_client", _open_in_memory)

        def progress(phase: str) -> None:
            if phase == "step":
                raise PeerLost("udpin://127.0.0.1:14540", "nothing new from the vehicle for 5 s")
            if phase == "land":
                raise PeerLost("udpin://127.0.0.1:14540", "nothing new from the vehicle for 5 s")

        with pytest.raises(FlightStoppedError) as stop:
            fly(job, progress)
        assert str(stop.value.cause).startswith("udpin://127.0.0.1:14540 went away")
        (journal,) = (state_dir / "restore").iterdir()
        backup = tmp_path / "set.backup.params"
        owed = "The vehicle's own parameters were NOT restored: run `froude restore`"
        assert stop.value.owed == (owed := f"{owed} (they are in {journal}, and in {backup})")
        assert stop.value.record.warnings == (owed,)
        assert (tmp_path / "set.backup.params").is_file()


def _open_in_memory(flight: Any) -> Any:
    job = flight._job
    flight._job = dataclasses.replace(job)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FlightJob, "in_memory", True)
        client = _OPEN(flight)
    return client


_OPEN = one_flight._Flight._open_client


class TestFilesThatCannotBeWritten:
    def test_in_flight_the_vehicle_lands_before_anybody_is_told(
        self, quick_job: Any, vehicles: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        write = TlogWriter.write
        frames = []

        def full(log: TlogWriter, time_us: int, frame: bytes) -> None:
            frames.append(time_us)
            if time_us > 15_000_000:
                raise log._unwritable(OSError(28, "No space left on device"))
            write(log, time_us, frame)

        monkeypatch.setattr(TlogWriter, "write", full)
        with pytest.raises(FlightStoppedError) as stop:
            fly(quick_job(job={"folder": tmp_path}))
        assert isinstance(stop.value.cause, FileError)
        assert "No space left on device" in str(stop.value.cause)
        assert len([time_us for time_us in frames if time_us > 15_000_000]) == 1
        assert left_as_found(vehicles[0])
        record = stop.value.record
        assert record.outcome is Outcome.PASS  # it was flown to its end and measured; only the log is not whole
        assert (tmp_path / "set.parquet").is_file()
        assert (tmp_path / "set.partial.rrd").is_file()
        assert not (tmp_path / "set.rrd").exists()

    def test_a_backup_that_cannot_be_kept_keeps_the_vehicle_as_it_is(
        self, quick_job: Any, vehicles: Any, tmp_path: Path
    ) -> None:
        (tmp_path / "set.backup.params").mkdir()
        with pytest.raises(FlightStoppedError) as stop:
            fly(quick_job(job={"folder": tmp_path}))
        assert "set.backup.params: cannot be written" in str(stop.value.cause)
        assert left_as_found(vehicles[0])
        assert not any("Armed" in event.text for event in stop.value.record.events)

    def test_at_the_end(self, quick_job: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def full(*_: Any, **__: Any) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr("pyarrow.parquet.write_table", full)
        with pytest.raises(FlightStoppedError) as stop:
            fly(quick_job(job={"folder": tmp_path}))
        assert "set.parquet: cannot be written" in str(stop.value.cause)
        assert stop.value.record.outcome is Outcome.PASS
        assert (tmp_path / "set.tlog").is_file()

    def test_a_folder_that_is_gone(self, quick_job: Any, tmp_path: Path) -> None:
        with pytest.raises(FlightStoppedError) as stop:
            fly(quick_job(job={"folder": tmp_path / "gone"}))
        assert isinstance(stop.value.cause, FileError)
        assert len(stop.value.record.telemetry) == 0


def test_a_defect_of_ours_closes_the_files_and_comes_out(quick_job: Any, vehicles: Any, tmp_path: Path) -> None:
    def progress(phase: str) -> None:
        if phase == "step":
            raise ZeroDivisionError("a bug")

    with pytest.raises(ZeroDivisionError):
        fly(quick_job(job={"folder": tmp_path}), progress)
    assert left_as_found(vehicles[0])
    assert (tmp_path / "set.partial.tlog").stat().st_size > 0
