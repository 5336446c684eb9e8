"""The vehicle's own logs, read by pyulog as anybody would read them."""

from __future__ import annotations

import errno
import os
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from pyulog import ULog
from pyulog.px4 import PX4ULog

from bridge.connection import Connection
from bridge.flight_log import MAX_TEXTS, FlightLog
from bridge.log_store import find_logs
from bridge.log_transfer import LogServer
from sitl.modes import Severity
from sitl.parameters import ParameterTable
from sitl.profile import get_profile
from sitl.setpoints import Sticks
from sitl.vehicle import Vehicle, airframe_parameters
from sitl.vehicle_spec import resolve_vehicle

UTC_US = 1_795_387_540_000_000

TOPICS = {
    "actuator_motors",
    "actuator_outputs",
    "battery_status",
    "control_allocator_status",
    "home_position",
    "rate_ctrl_status",
    "sensor_combined",
    "vehicle_angular_velocity",
    "vehicle_angular_velocity_groundtruth",
    "vehicle_attitude",
    "vehicle_attitude_groundtruth",
    "vehicle_attitude_setpoint",
    "vehicle_control_mode",
    "vehicle_global_position",
    "vehicle_gps_position",
    "vehicle_land_detected",
    "vehicle_local_position",
    "vehicle_local_position_groundtruth",
    "vehicle_local_position_setpoint",
    "vehicle_rates_setpoint",
    "vehicle_status",
    "vehicle_thrust_setpoint",
    "vehicle_torque_setpoint",
}


class Logged:
    """A vehicle with a log, from arming to disarming unless SDLOG_MODE says otherwise."""

    def __init__(self, directory, *, vehicle="ant-x", parameters=None, **options):
        model, profile = resolve_vehicle(vehicle), get_profile("sitl")
        table = ParameterTable({**airframe_parameters(model, profile), "SDLOG_MODE": 0})
        self.vehicle = Vehicle(model, profile, parameters=table)
        for name, value in (parameters or {}).items():
            self.vehicle.parameters.set(name, value)
        self.said = []
        self.directory = directory
        self.log = FlightLog(directory, self.vehicle, say=lambda *text: self.said.append(text), **options)

    def run(self, seconds):
        for _ in range(round(seconds * 1e6 / self.vehicle.tick_us)):
            self.vehicle.step()
            self.log.tick()

    def arm(self, arm=True):
        assert self.vehicle.autopilot.command_arm(arm, force=True) == 0

    def fly(self, seconds=6.0, height_m=5.0):
        """Arm, take off, be somewhere in the air."""
        self.run(3.0)
        self.arm()
        self.vehicle.autopilot.command_takeoff(self.vehicle.origin[2] + height_m)
        self.run(seconds)

    def logs(self):
        return [log.path for log in find_logs(self.directory)]

    def read(self, number=0):
        ulog = ULog(str(self.logs()[number]), disable_str_exceptions=False)
        assert not ulog.file_corruption
        assert not ulog.dropouts
        return ulog


def data(ulog, topic):
    return ulog.get_dataset(topic).data


def times(ulog, topic):
    return data(ulog, topic)["timestamp"].astype(np.int64)


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A flight from arming to disarming in the air, with what the vehicle did at every tick."""
    one = Logged(tmp_path_factory.mktemp("flown"), utc_boot_us=UTC_US, facts={"froude_test": "yes"})
    one.fly()
    one.vehicle.parameters.set("MC_ROLLRATE_P", 0.25)
    one.log.text(Severity.INFO, "Takeoff detected\t")
    one.rates = {}
    for _ in range(500):
        one.run(0.004)
        one.rates[one.vehicle.time_us] = one.vehicle.estimate.rates(), one.vehicle.truth.quat()
    one.disarmed_us = one.vehicle.time_us
    one.arm(False)
    one.run(3.0)
    one.ulog = one.read()
    return one


def test_a_flight_is_one_file_named_by_its_time_of_day(flown):
    assert [path.relative_to(flown.directory).as_posix() for path in flown.logs()] == ["2026-11-22/22_45_43.ulg"]
    assert flown.log.path is None
    assert flown.ulog.start_timestamp == pytest.approx(3_004_000, abs=4_000)
    assert flown.ulog.last_timestamp == pytest.approx(flown.disarmed_us + 1_000_000, abs=20_000)


def test_every_topic_is_there_with_rising_times(flown):
    assert {one.name for one in flown.ulog.data_list} == TOPICS
    for one in flown.ulog.data_list:
        stamps = one.data["timestamp"].astype(np.int64)
        assert (np.diff(stamps) > 0).all() or one.name == "vehicle_gps_position"
        assert stamps[0] >= flown.ulog.start_timestamp - 100_000
        assert not any(name.startswith("_padding") for name in one.data)


@pytest.mark.parametrize(
    ("topic", "rate_hz"),
    [
        ("sensor_combined", 250),
        ("vehicle_attitude", 100),
        ("vehicle_angular_velocity", 100),
        ("vehicle_angular_velocity_groundtruth", 100),
        ("vehicle_rates_setpoint", 50),
        ("vehicle_torque_setpoint", 50),
        ("vehicle_local_position", 50),
        ("vehicle_attitude_setpoint", 20),
        ("actuator_motors", 10),
        ("vehicle_gps_position", 10),
        ("rate_ctrl_status", 5),
        ("battery_status", 5),
    ],
)
def test_rates(flown, topic, rate_hz):
    stamps = times(flown.ulog, topic)
    assert (len(stamps) - 1) / (stamps[-1] - stamps[0]) * 1e6 == pytest.approx(rate_hz, rel=0.05)


def test_the_samples_are_what_the_vehicle_did(flown):
    seen = 0
    rates = data(flown.ulog, "vehicle_angular_velocity")
    truth = data(flown.ulog, "vehicle_attitude_groundtruth")
    for number, stamp in enumerate(rates["timestamp"].tolist()):
        if stamp in flown.rates:
            seen += 1
            wanted, quat = flown.rates[stamp]
            assert [rates[f"xyz[{axis}]"][number] for axis in range(3)] == pytest.approx(wanted, abs=1e-6)
            assert truth["timestamp"][number] == stamp
            assert [truth[f"q[{axis}]"][number] for axis in range(4)] == pytest.approx(quat, abs=1e-6)
    assert seen == 200
    height = -data(flown.ulog, "vehicle_local_position_groundtruth")["z"]
    assert height.max() == pytest.approx(5.0, abs=0.5)
    assert data(flown.ulog, "vehicle_global_position")["alt"].max() == pytest.approx(493.0, abs=0.5)
    motors = data(flown.ulog, "actuator_motors")
    assert (motors["control[3]"] > 0.1).any()
    assert np.isnan(motors["control[4]"]).all(), "four motors"
    outputs = data(flown.ulog, "actuator_outputs")
    assert outputs["noutputs"].max() == 4
    assert outputs["output[0]"].min() == 900
    assert 1100 < outputs["output[0]"].max() <= 2000
    accel = data(flown.ulog, "vehicle_local_position")["az"]
    assert np.abs(accel[:100]).max() < 1.0, "on the ground nothing accelerates: gravity is taken out"


def test_vehicle_status_tells_the_flight(flown):
    status = flown.ulog.get_dataset("vehicle_status")
    armed = status.list_value_changes("arming_state")
    assert [state for _, state in armed] == [2, 1]
    assert int(armed[1][0]) == pytest.approx(flown.disarmed_us, abs=20_000)
    assert next(state for _, state in status.list_value_changes("nav_state")) in (4, 17)
    assert 17 in status.data["nav_state"]
    assert int(status.data["armed_time"].max()) == pytest.approx(3_004_000, abs=20_000)
    assert 0 < status.data["takeoff_time"].max() < flown.disarmed_us
    landed = [value for _, value in flown.ulog.get_dataset("vehicle_land_detected").list_value_changes("landed")]
    assert landed == [1, 0, 1]


def test_parameters_defaults_and_changes(flown):
    table = flown.vehicle.parameters
    ulog = flown.ulog
    assert set(ulog.initial_parameters) == set(table.names)
    assert ulog.initial_parameters["MC_ROLLRATE_P"] == table.default("MC_ROLLRATE_P")
    assert ulog.initial_parameters["CA_ROTOR_COUNT"] == 4
    assert ulog.has_default_parameters
    assert ulog.get_default_parameters(0)["CA_ROTOR_COUNT"] == table.spec("CA_ROTOR_COUNT").default
    assert ulog.get_default_parameters(1) == {}
    ((stamp, name, value),) = ulog.changed_parameters
    assert (name, value) == ("MC_ROLLRATE_P", 0.25)
    assert stamp == pytest.approx(9_000_000, abs=20_000)


def test_parameters_that_are_not_at_their_default(tmp_path):
    one = Logged(tmp_path, parameters={"MC_ROLLRATE_P": 0.5, "CA_ROTOR_COUNT": 5, "SDLOG_MODE": 2})
    one.run(0.1)
    one.log.close()
    ulog = one.read()
    default = one.vehicle.parameters.default("MC_ROLLRATE_P")
    assert ulog.initial_parameters["MC_ROLLRATE_P"] == 0.5
    assert [ulog.get_default_parameters(kind)["MC_ROLLRATE_P"] for kind in (0, 1)] == [default, default]
    assert ulog.get_default_parameters(0)["CA_ROTOR_COUNT"] == one.vehicle.parameters.spec("CA_ROTOR_COUNT").default
    assert ulog.get_default_parameters(1)["CA_ROTOR_COUNT"] == 4


def test_information_says_what_this_is(flown):
    facts = flown.ulog.msg_info_dict
    assert facts["sys_name"] == "PX4"
    assert facts["ver_hw"] == "FROUDE_SITL"
    assert facts["froude_vehicle"] == "ANT-X"
    assert facts["froude_test"] == "yes"
    assert facts["ver_data_format"] == 2
    assert facts["boot_time_utc_us"] == UTC_US
    assert flown.ulog.get_version_info() is not None
    assert flown.ulog.get_version_info()[3] == 255
    ((text,),) = ([(one.message, one.log_level_str()) for one in flown.ulog.logged_messages],)
    assert text == ("Takeoff detected", "INFO")


def test_the_px4_helpers_of_pyulog(flown):
    helper = PX4ULog(flown.ulog)
    assert helper.get_mav_type() == "Quadrotor"
    assert helper.get_estimator() == "EKF2"
    helper.get_configured_rc_input_names(0)
    helper.add_roll_pitch_yaw()
    assert np.abs(data(flown.ulog, "vehicle_attitude")["roll"]).max() < 0.5
    assert np.isfinite(data(flown.ulog, "vehicle_attitude_setpoint")["pitch_d"]).all()


def test_logging_changes_nothing_of_the_flight(flown, tmp_path):
    quiet = Vehicle(resolve_vehicle("ant-x"), get_profile("sitl"))
    one = Logged(tmp_path, parameters={"SDLOG_PROFILE": 25})
    one.fly(2.0)
    while quiet.time_us < 3_000_000:
        quiet.step()
    quiet.parameters.set("SDLOG_PROFILE", 25)
    quiet.autopilot.command_arm(True)
    quiet.autopilot.command_takeoff(quiet.origin[2] + 5.0)
    while quiet.time_us < one.vehicle.time_us:
        quiet.step()
    assert quiet.plant.x.tobytes() == one.vehicle.plant.x.tobytes()


def test_the_same_flight_is_the_same_file(tmp_path):
    files = []
    for name in ("a", "b"):
        one = Logged(tmp_path / name)
        one.fly(1.0)
        one.log.close()
        files.append(one.logs()[0].read_bytes())
    assert files[0] == files[1]


@pytest.mark.parametrize(("profile", "rate_hz"), [(16, 250), (1 | 16, 250), (8, 250), (1, 100), (0, 100), (2, 100)])
def test_profiles(tmp_path, profile, rate_hz):
    one = Logged(tmp_path, parameters={"SDLOG_PROFILE": profile})
    one.fly(3.0)
    one.log.close()
    ulog = one.read()
    assert np.diff(times(ulog, "vehicle_angular_velocity")).mean() == pytest.approx(1e6 / rate_hz, rel=0.02)
    names = {topic.name for topic in ulog.data_list}
    assert ("vehicle_rates_setpoint" in names) == (profile != 8)
    if profile & 16:
        for topic in ("vehicle_rates_setpoint", "vehicle_torque_setpoint", "vehicle_attitude", "actuator_motors"):
            assert (np.diff(times(ulog, topic)) == one.vehicle.tick_us).all()
        assert np.diff(times(ulog, "rate_ctrl_status")).mean() == pytest.approx(20_000, rel=0.02)


def armed_twice(one):
    """Logs after boot, a flight and another, and whether one is being written at each moment."""
    writing = []
    for seconds, arm in ((1.0, None), (2.0, True), (0.5, False), (2.0, None), (1.0, True), (3.0, False)):
        if arm is not None:
            one.arm(arm)
        one.run(seconds if one.vehicle.autopilot.healthy else 3.0)
        writing.append(one.log.path is not None)
    one.log.close()
    return len(one.logs()), writing


@pytest.mark.parametrize(
    ("mode", "logs", "writing"),
    [
        (-1, 0, [False] * 6),
        (0, 2, [False, True, True, False, True, False]),
        (1, 2, [True, True, True, False, True, False]),
        (2, 1, [True] * 6),
        (3, 2, [False, True, True, False, True, False]),
        (4, 1, [False, *[True] * 5]),
    ],
)
def test_when_it_logs(tmp_path, mode, logs, writing):
    assert armed_twice(Logged(tmp_path, parameters={"SDLOG_MODE": mode})) == (logs, writing)


def test_without_a_time_of_day_sessions_are_counted(tmp_path):
    for session in ("sess001", "sess002"):
        one = Logged(tmp_path)
        armed_twice(one)
        assert {path.parent.name for path in one.logs()} >= {session}
    names = [path.relative_to(tmp_path).as_posix() for path in one.logs()]
    assert names == ["sess001/log100.ulg", "sess001/log101.ulg", "sess002/log100.ulg", "sess002/log101.ulg"]


def test_a_process_that_dies_loses_less_than_a_tenth_of_a_second(tmp_path):
    one = Logged(tmp_path)
    one.fly(5.5)
    ulog = one.read()  # nobody closed it
    assert one.vehicle.time_us - ulog.last_timestamp < 100_000
    assert len(ulog.initial_parameters) == len(one.vehicle.parameters)


def test_a_file_cut_anywhere_can_be_read_up_to_there(tmp_path):
    one = Logged(tmp_path)
    one.fly(2.0)
    one.log.close()
    (path,) = one.logs()
    whole, cut = path.read_bytes(), tmp_path / "cut.ulg"
    for size in range(len(whole) - 997, len(whole), 83):
        cut.write_bytes(whole[:size])
        ulog = ULog(str(cut))
        assert not ulog.file_corruption
        assert len(data(ulog, "sensor_combined")["timestamp"]) > 200


def test_a_directory_that_cannot_be_written_stops_the_log_and_not_the_flight(tmp_path):
    (tmp_path / "file").touch()
    one = Logged(tmp_path / "file")
    one.fly(3.0)
    assert one.vehicle.autopilot.armed
    ((severity, text),) = one.said
    assert severity == Severity.ERROR
    assert "Logging stopped" in text
    assert str(tmp_path / "file") in text
    assert one.log.failures == 1
    (tmp_path / "file").unlink()
    one.arm(False)
    one.run(0.1)
    one.arm()
    one.run(0.1)
    assert one.log.path is not None, "the next arming tries again"


class Disk:
    """Files on it take so many bytes, and none while it stands still."""

    def __init__(self, monkeypatch, room=10**9):
        self.goes_on, self.room = threading.Event(), room
        self.goes_on.set()

        def write(file, chunk):
            assert self.goes_on.wait(60.0)
            if self.room <= 0:
                raise OSError(errno.ENOSPC, "No space left on device")
            done = os.write(file, chunk[: self.room])
            self.room -= done
            return done

        monkeypatch.setattr("bridge.behind_file.write", write)


def until(condition):
    for _ in range(6000):
        if condition():
            return
        time.sleep(0.01)
    pytest.fail("never so")


@pytest.mark.parametrize("behind", [False, True])
def test_a_full_disk_leaves_a_valid_file(tmp_path, monkeypatch, behind):
    disk = Disk(monkeypatch)
    one = Logged(tmp_path, behind=behind)
    one.fly(2.5)
    until(lambda: one.log.path.stat().st_size > 100_000)  # a thread may have written it
    disk.room = 1000

    def told():
        one.run(0.2)
        return one.said

    until(told)
    ((severity, text),) = one.said
    assert severity == Severity.ERROR
    assert "No space left on device" in text
    assert str(tmp_path) in text
    assert one.log.path is None
    one.run(3.0)
    ulog = one.read()
    assert not ulog.file_corruption
    assert ulog.last_timestamp < one.vehicle.time_us - 2_500_000
    one.log.text(Severity.INFO, "nobody logs this")
    one.log.close()
    assert len(one.said) == 1


def test_a_disk_that_stands_still_keeps_no_vehicle_waiting_and_nothing_is_lost(tmp_path, monkeypatch):
    disk = Disk(monkeypatch)
    one = Logged(tmp_path, behind=True)
    disk.goes_on.clear()
    one.fly(4.0)
    (file,) = tmp_path.rglob("*.ulg")
    assert file.stat().st_size == 0
    one.arm(False)
    one.run(2.0)  # the log has ended, the file has not
    one.arm()
    one.run(0.5)
    assert one.log.path not in (None, file)
    disk.goes_on.set()
    one.log.close()
    assert one.said == []
    whole, later = sorted(tmp_path.rglob("*.ulg"))
    assert whole == file
    times_us = data(ULog(str(whole)), "vehicle_attitude")["timestamp"]
    assert times_us[-1] - times_us[0] > 3_500_000
    assert len(data(ULog(str(later)), "vehicle_attitude")["timestamp"]) > 20


def test_what_the_disk_did_not_take_at_the_end_is_told_too(tmp_path, monkeypatch):
    disk = Disk(monkeypatch)
    one = Logged(tmp_path, behind=True)
    disk.goes_on.clear()
    one.fly(1.0)
    disk.room = 0
    disk.goes_on.set()
    one.log.close()
    assert [text for _, text in one.said if "No space left on device" in text]
    assert one.log.failures == 1


def test_a_log_is_downloaded_while_it_is_written_and_survives_an_erasure(tmp_path):
    one = Logged(tmp_path)
    one.fly(2.5)
    server = LogServer(tmp_path, writing=lambda: one.log.path)
    ground, got = Connection(255, 190, datagram=True), []

    def ask(name, **fields):
        frame = ground.encode(name, target_system=1, target_component=1, **fields)
        (message,) = Connection(1, 1, datagram=True).receive(frame)
        server.handle(message, 0, one.vehicle.time_us)

    ask("LOG_ERASE")
    ask("LOG_REQUEST_LIST", start=0, end=0xFFFF)
    one.run(0.004)
    ((_, entry),) = server.poll(0, one.vehicle.time_us)
    ask("LOG_REQUEST_DATA", id=0, ofs=0, count=0xFFFFFFFF)
    for _ in range(1000):
        one.run(0.004)
        got += [fields["data"] for _, fields in server.poll(0, one.vehicle.time_us)]
    (tmp_path / "got.ulg").write_bytes(b"".join(got))
    assert (tmp_path / "got.ulg").stat().st_size == entry["size"]
    ulog = ULog(str(tmp_path / "got.ulg"))
    assert not ulog.file_corruption
    assert one.vehicle.time_us - ulog.last_timestamp > 3_900_000
    one.log.close()
    assert one.logs()[0].read_bytes().startswith(b"".join(got))


def test_old_logs_make_room(tmp_path):
    old = tmp_path / "sess001"
    old.mkdir()
    for number in range(100, 104):
        (old / f"log{number}.ulg").write_bytes(bytes(1_000_000))
    one = Logged(tmp_path, max_total_bytes=4_000_000)
    one.fly(0.5)
    names = [path.relative_to(tmp_path).as_posix() for path in one.logs()]
    assert names == ["sess001/log102.ulg", "sess001/log103.ulg", "sess002/log100.ulg"]


def test_a_log_without_end_is_cut_into_files_and_stays_bounded(tmp_path):
    one = Logged(tmp_path, parameters={"SDLOG_MODE": 2, "SDLOG_PROFILE": 17}, max_total_bytes=1)
    most = 0
    for _ in range(6):
        one.run(10.0)
        most = max(most, sum(path.stat().st_size for path in one.logs()))
    assert one.logs()[-1].name > "log102.ulg"
    assert most < 2_500_000
    newest = one.read(-1)
    assert newest.start_timestamp > 20_000_000


def test_folders_of_old_sessions_are_bounded(tmp_path):
    for number in range(1, 6):
        (tmp_path / f"sess{number:03d}").mkdir()
        (tmp_path / f"sess{number:03d}" / "log100.ulg").touch()
    one = Logged(tmp_path, parameters={"SDLOG_DIRS_MAX": 2})
    one.fly(0.5)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["sess004", "sess005", "sess006"]


def test_texts_are_bounded(tmp_path):
    one = Logged(tmp_path)
    one.log.text(Severity.INFO, "before")
    one.fly(0.5)
    for number in range(1000):
        one.log.text(Severity.WARNING, f"text {number}")
    one.log.close()
    texts = [text.message for text in one.read().logged_messages]
    assert texts == [f"text {number}" for number in range(MAX_TEXTS)]
    assert one.log.dropped_texts == 1000 - MAX_TEXTS


def test_texts_that_go_on_are_bounded_by_the_second(tmp_path):
    one = Logged(tmp_path)
    one.fly(0.5)
    for _ in range(300):  # of three seconds
        for number in range(10):
            one.log.text(Severity.WARNING, f"text {number}")
        one.run(0.01)
    assert 3 * MAX_TEXTS <= 3000 - one.log.dropped_texts <= 5 * MAX_TEXTS


def test_sticks_are_logged_while_there_are_any(tmp_path):
    held = []
    one = Logged(tmp_path, sticks=lambda: held[0] if held else None)
    one.fly(1.0)
    held.append(Sticks(0.1, -0.2, 0.3, -0.4))
    one.run(1.0)
    one.log.close()
    sticks = data(one.read(), "manual_control_setpoint")
    assert times(one.read(), "manual_control_setpoint")[0] >= 4_000_000
    assert [sticks[name][-1] for name in ("roll", "pitch", "yaw", "throttle")] == pytest.approx([0.1, -0.2, 0.3, -0.4])


@pytest.mark.parametrize("vehicle", ["ant-r", "adam-0"])
@pytest.mark.parametrize("profile", ["study", "board"])
def test_every_vehicle_and_profile(tmp_path, vehicle, profile):
    one = Vehicle(resolve_vehicle(vehicle), get_profile(profile))
    one.parameters.set("SDLOG_MODE", 2)
    log = FlightLog(tmp_path, one)
    for _ in range(round(1.5e6 / one.tick_us)):
        one.step()
        log.tick()
    log.close()
    ulog = ULog(str(find_logs(tmp_path)[0].path))
    assert not ulog.file_corruption
    assert np.diff(times(ulog, "sensor_combined")).mean() == pytest.approx(one.tick_us)
    count = one.autopilot.motor_count
    assert not np.isnan(data(ulog, "actuator_motors")[f"control[{count - 1}]"]).any()


def test_a_vehicle_that_diverges_is_logged(tmp_path):
    one = Logged(tmp_path, parameters={"SDLOG_MODE": 2})
    one.run(1.0)
    one.vehicle.plant.x[:] = 1e300
    one.vehicle.autopilot.state["torque_sp"][:] = np.inf
    one.vehicle.tick += 5
    one.log.tick()
    one.log.close()
    assert np.isinf(data(one.read(), "vehicle_local_position_groundtruth")["x"]).any()


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="counts descriptors in /proc")
def test_no_descriptor_is_left_open(tmp_path):
    before = len(list(Path("/proc/self/fd").iterdir()))
    armed_twice(Logged(tmp_path))
    assert len(list(Path("/proc/self/fd").iterdir())) == before
