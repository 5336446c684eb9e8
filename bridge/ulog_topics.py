"""What a log says of the vehicle's state: PX4's topics that change slowly, and how often each is written.

Names, types and units of the fields are uORB's (PX4 msg/ and msg/versioned/, main of 2026); those this vehicle has
nothing for are zero, or NaN where PX4 means "unknown". The topics of every control tick are in `bridge.ulog_ring`.

Intervals follow PX4's src/modules/logger/logged_topics.cpp: its default set with what it adds for simulators, and the
sets for fast manoeuvres and for system identification where SDLOG_PROFILE asks for them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntFlag
from typing import Any, Final

from bridge.ulog import Layout
from sitl.control_settings import mix_of
from sitl.modes import EXTERNAL_MODES, STICK_MODES, Home, Mode
from sitl.rotation import to_euler
from sitl.sensors import geodetic
from sitl.setpoints import Sticks
from sitl.vehicle import Vehicle

NAN: Final = math.nan

Values = tuple[Any, ...]


class Profile(IntFlag):
    """Bits of SDLOG_PROFILE that make a difference here."""

    DEFAULT = 1
    SYSTEM_IDENTIFICATION = 8
    HIGH_RATE = 16


@dataclass(frozen=True)
class Topic:
    """A topic that is sampled on its own.

    Attributes:
        layout: its fields.
        period_us: between two samples, us; 0 for whenever it changed.
        sample: the values at a vehicle time (us) in the layout's order, None while there is nothing to say.
        key: what must differ for a sample out of turn; None: only the period counts.
    """

    layout: Layout
    period_us: int
    sample: Callable[[int], Values | None]
    key: Callable[[], object] | None = None


STATUS: Final = Layout(
    "vehicle_status",
    "uint64_t timestamp;uint64_t armed_time;uint64_t takeoff_time;uint64_t nav_state_timestamp;"
    "uint32_t valid_nav_states_mask;uint32_t can_set_nav_states_mask;uint16_t failure_detector_status;"
    "uint8_t arming_state;uint8_t latest_arming_reason;uint8_t latest_disarming_reason;"
    "uint8_t nav_state_user_intention;uint8_t nav_state;uint8_t executor_in_charge;uint8_t hil_state;"
    "uint8_t vehicle_type;bool failsafe;bool failsafe_and_user_took_over;uint8_t failsafe_defer_state;"
    "bool gcs_connection_lost;uint8_t gcs_connection_lost_counter;bool high_latency_data_link_lost;bool is_vtol;"
    "bool is_vtol_tailsitter;bool in_transition_mode;bool in_transition_to_fw;uint8_t system_type;uint8_t system_id;"
    "uint8_t component_id;bool safety_button_available;bool safety_off;bool power_input_valid;bool usb_connected;"
    "bool open_drone_id_system_present;bool open_drone_id_system_healthy;bool parachute_system_present;"
    "bool parachute_system_healthy;bool rc_calibration_in_progress;bool calibration_enabled;"
    "bool pre_flight_checks_pass",
)
CONTROL_MODE: Final = Layout(
    "vehicle_control_mode",
    "uint64_t timestamp;bool flag_armed;bool flag_multicopter_position_control_enabled;"
    "bool flag_control_manual_enabled;bool flag_control_auto_enabled;bool flag_control_offboard_enabled;"
    "bool flag_control_position_enabled;bool flag_control_velocity_enabled;bool flag_control_altitude_enabled;"
    "bool flag_control_climb_rate_enabled;bool flag_control_acceleration_enabled;bool flag_control_attitude_enabled;"
    "bool flag_control_rates_enabled;bool flag_control_allocation_enabled;bool flag_control_termination_enabled;"
    "uint8_t source_id",
)
LAND_DETECTED: Final = Layout(
    "vehicle_land_detected",
    "uint64_t timestamp;bool freefall;bool ground_contact;bool maybe_landed;bool landed;bool in_ground_effect;"
    "bool in_descend;bool has_low_throttle;bool vertical_movement;bool horizontal_movement;bool rotational_movement;"
    "bool close_to_ground_or_skipped_check;bool at_rest",
)
HOME: Final = Layout(
    "home_position",
    "uint64_t timestamp;double lat;double lon;float alt;float x;float y;float z;float roll;float pitch;float yaw;"
    "uint32_t update_count;bool valid_alt;bool valid_hpos;bool valid_lpos;bool manual_home",
)
ATTITUDE_SP: Final = Layout(
    "vehicle_attitude_setpoint",
    "uint64_t timestamp;float yaw_sp_move_rate;float[4] q_d;float[3] thrust_body",
)
POSITION_SP: Final = Layout(
    "vehicle_local_position_setpoint",
    "uint64_t timestamp;float x;float y;float z;float yaw;float yawspeed;float vx;float vy;float vz;"
    "float[3] acceleration;float[3] jerk;float[3] thrust",
)
GLOBAL_FIELDS: Final = (
    "uint64_t timestamp;uint64_t timestamp_sample;double lat;double lon;float alt;float alt_ellipsoid;float delta_alt;"
    "float delta_terrain;float eph;float epv;float terrain_alt;bool lat_lon_valid;bool alt_valid;"
    "uint8_t lat_lon_reset_counter;uint8_t alt_reset_counter;uint8_t terrain_reset_counter;bool terrain_alt_valid;"
    "bool dead_reckoning"
)
GLOBAL: Final = Layout("vehicle_global_position", GLOBAL_FIELDS)
GPS: Final = Layout(
    "vehicle_gps_position",
    "uint64_t timestamp;uint64_t timestamp_sample;double latitude_deg;double longitude_deg;double altitude_msl_m;"
    "double altitude_ellipsoid_m;uint64_t time_utc_usec;uint32_t device_id;float s_variance_m_s;float c_variance_rad;"
    "float eph;float epv;float hdop;float vdop;int32_t noise_per_ms;int32_t jamming_indicator;float vel_m_s;"
    "float vel_n_m_s;float vel_e_m_s;float vel_d_m_s;float cog_rad;int32_t timestamp_time_relative;"
    "uint32_t system_error;float heading;float heading_offset;float heading_accuracy;float rtcm_injection_rate;"
    "uint16_t automatic_gain_control;uint8_t fix_type;uint8_t jamming_state;uint8_t spoofing_state;"
    "uint8_t authentication_state;bool vel_ned_valid;uint8_t satellites_used;uint8_t selected_rtcm_instance;"
    "bool rtcm_crc_failed;uint8_t rtcm_msg_used;uint8_t quality_corrections;uint8_t quality_receiver;"
    "uint8_t quality_gnss_signals;uint8_t quality_post_processing",
)
BATTERY: Final = Layout(
    "battery_status",
    "uint64_t timestamp;float voltage_v;float current_a;float current_average_a;float discharged_mah;float remaining;"
    "float scale;float time_remaining_s;float temperature;float[14] voltage_cell_v;float max_cell_voltage_delta;"
    "float full_charge_capacity_wh;float remaining_capacity_wh;float nominal_voltage;"
    "float internal_resistance_estimate;float ocv_estimate;float ocv_estimate_filtered;float volt_based_soc_estimate;"
    "float voltage_prediction;float prediction_error;float estimation_covariance_norm;uint16_t capacity;"
    "uint16_t cycle_count;uint16_t average_time_to_empty;uint16_t manufacture_date;uint16_t state_of_health;"
    "uint16_t max_error;uint16_t interface_error;uint16_t faults;uint16_t over_discharge_count;bool connected;"
    "uint8_t cell_count;uint8_t source;uint8_t priority;uint8_t id;bool is_powering_off;bool is_required;"
    "uint8_t warning",
)
OUTPUTS: Final = Layout("actuator_outputs", "uint64_t timestamp;float[16] output;uint8_t noutputs")
ALLOCATOR: Final = Layout(
    "control_allocator_status",
    "uint64_t timestamp;float[3] unallocated_torque;float[3] unallocated_thrust;uint16_t handled_motor_failure_mask;"
    "uint16_t motor_stop_mask;bool torque_setpoint_achieved;bool thrust_setpoint_achieved;"
    "int8_t[16] actuator_saturation",
)
MANUAL: Final = Layout(
    "manual_control_setpoint",
    "uint64_t timestamp;uint64_t timestamp_sample;float roll;float pitch;float yaw;float throttle;float flaps;"
    "float aux1;float aux2;float aux3;float aux4;float aux5;float aux6;uint16_t buttons;bool valid;"
    "uint8_t data_source;bool sticks_moving;uint8_t sender_system_id;uint8_t sender_component_id",
)

_AVAILABLE_MASK = sum(1 << int(mode) for mode in Mode if mode not in EXTERNAL_MODES)
_NO_CLIMB = {Mode.MANUAL, Mode.STABILIZED, Mode.ACRO, Mode.OFFBOARD, Mode.TERMINATION}
_NO_POSITION = _NO_CLIMB | {Mode.ALTCTL, Mode.ALTITUDE_CRUISE, Mode.DESCEND}
_ACHIEVED = 1e-6
"""Square of the unallocated torque below which PX4 calls a set-point achieved."""


class StateTopics:
    """The slow topics of one vehicle.

    Args:
        vehicle: what is logged. system_id: its own. profile: bits of SDLOG_PROFILE.
        utc_boot_us: UTC at vehicle time 0, us; 0 for unknown.
        sticks: the pilot's sticks, None while there are none.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        *,
        system_id: int,
        profile: Profile,
        utc_boot_us: int = 0,
        sticks: Callable[[], Sticks | None] = lambda: None,
    ) -> None:
        self._vehicle = vehicle
        self._autopilot = vehicle.autopilot
        self._system_id = system_id
        self._utc_boot_us = utc_boot_us
        self._sticks = sticks
        self._armed_us = self._takeoff_us = self._mode_us = 0
        self._mode: Mode | None = None
        self._homes = 0
        self._home: Home | None = None
        self._inverse_revision = -1
        self._discharged_mah = 0.0
        self._battery_us = vehicle.time_us
        fast = bool(profile & Profile.HIGH_RATE)
        self.topics: tuple[Topic, ...] = (
            Topic(STATUS, 500_000, self._status, self._status_key),
            Topic(CONTROL_MODE, 500_000, self._control_mode, self._status_key),
            Topic(LAND_DETECTED, 1_000_000, self._land_detected, self._land_flags),
            Topic(HOME, 0, self._home_position, lambda: vehicle.autopilot.home),
            Topic(ATTITUDE_SP, 0 if fast else 50_000, self._attitude_sp, self._attitude_sp_count if fast else None),
            Topic(POSITION_SP, 100_000, self._position_sp),
            Topic(GLOBAL, 100_000, self._global_position),
            Topic(GPS, 100_000, self._gps),
            Topic(BATTERY, 200_000, self._battery),
            Topic(OUTPUTS, 20_000 if fast else 100_000, self._outputs),
            Topic(ALLOCATOR, 20_000 if fast else 200_000, self._allocator),
            Topic(MANUAL, 20_000 if fast else 200_000, self._manual),
        )

    def _status_key(self) -> object:
        autopilot = self._autopilot
        return autopilot.mode, autopilot.armed, autopilot.failsafe, autopilot.land_detector.landed

    def _status(self, now_us: int) -> Values:
        autopilot = self._autopilot
        armed, mode = autopilot.armed, autopilot.mode
        self._armed_us = (self._armed_us or now_us) if armed else 0
        flying = armed and not autopilot.land_detector.landed
        self._takeoff_us = (self._takeoff_us or now_us) if flying else 0
        if mode is not self._mode:
            self._mode, self._mode_us = mode, now_us
        nav_state = int(mode)
        mav_type = int(self._vehicle.parameters.get("MAV_TYPE")) & 0xFF
        return (
            *(now_us, self._armed_us, self._takeoff_us, self._mode_us),
            *(
                _AVAILABLE_MASK,
                _AVAILABLE_MASK,
                0,
                2 if armed else 1,
                0,
                0,
                int(self._autopilot.intended),
                nav_state,
                0,
                0,
            ),
            *(1, autopilot.failsafe, False, 0),
            *(False, 0, False, False, False, False, False, mav_type, self._system_id, 1),
            *(False, True, True, False, False, False, False, False, False, False, autopilot.ready),
        )

    def _control_mode(self, now_us: int) -> Values:
        mode, armed = self._autopilot.mode, self._autopilot.armed
        manual, offboard, ended = mode in STICK_MODES, mode is Mode.OFFBOARD, mode is Mode.TERMINATION
        position, climb = mode not in _NO_POSITION, mode not in _NO_CLIMB
        altitude = climb and mode is not Mode.DESCEND
        attitude = mode is not Mode.ACRO and not ended
        auto = not manual and not offboard and not ended
        return (
            *(now_us, armed, armed and climb, manual, auto, offboard, position, position, altitude, climb, False),
            *(attitude, not ended, True, ended, int(mode)),
        )

    def _land_flags(self) -> object:
        detector = self._autopilot.land_detector
        return detector.ground_contact, detector.maybe_landed, detector.landed

    def _land_detected(self, now_us: int) -> Values:
        detector = self._autopilot.land_detector
        flags = (detector.ground_contact, detector.maybe_landed, detector.landed)
        return now_us, False, *flags, *[False] * 7, detector.landed

    def _home_position(self, now_us: int) -> Values | None:
        home = self._autopilot.home
        if home is None:
            return None
        if home is not self._home:
            self._home, self._homes = home, self._homes + 1
        place = (home.lat_deg, home.lon_deg, home.alt_m, *home.position_ned, *to_euler(home.quat))
        return now_us, *place, self._homes, True, True, True, False

    def _attitude_sp_count(self) -> object:
        return self._autopilot.attitude_sp_count

    def _attitude_sp(self, now_us: int) -> Values | None:
        sp = self._autopilot.attitude_sp
        if not sp.serial:
            return None
        return now_us, NAN, *sp.quat, 0.0, 0.0, -sp.thrust

    def _position_sp(self, now_us: int) -> Values | None:
        autopilot = self._autopilot
        if not autopilot.armed or not autopilot.by_position:
            return None
        sp = autopilot.position_sp
        free = (NAN, NAN, NAN)
        return now_us, *sp.position_ned, sp.yaw, sp.yaw_rate, *sp.velocity_ned, *sp.acceleration_ned, *free, *free

    def _global_position(self, now_us: int) -> Values | None:
        if not self._autopilot.healthy:
            return None
        fix = self._vehicle.gps()
        lat, lon, alt = geodetic(self._vehicle.estimate.position_ned(), self._vehicle.origin)
        return (
            *(now_us, now_us, lat, lon, alt, alt, 0.0, 0.0, fix.eph_m, fix.epv_m, NAN),
            *(True, True, 0, 0, 0, False, False),
        )

    def _gps(self, now_us: int) -> Values:
        fix = self._vehicle.gps()
        north, east, down = fix.vel_ned
        utc_us = self._utc_boot_us + fix.time_us if self._utc_boot_us else 0
        return (
            *(fix.time_us, fix.time_us, fix.lat_deg, fix.lon_deg, fix.alt_m, fix.alt_m, utc_us, 0, 0.2, 0.1),
            *(fix.eph_m, fix.epv_m, 0.7, 1.1, 0, 0, math.hypot(north, east), north, east, down),
            *(math.atan2(east, north), 0, 0, NAN, NAN, NAN, 0.0),
            *(0, fix.fix_type, 0, 0, 0, True, fix.satellites, 0, False, 0, 0, 0, 0, 0),
        )

    def _battery(self, now_us: int) -> Values:
        battery = self._vehicle.battery()
        self._discharged_mah += battery.current_a * (now_us - self._battery_us) / 3.6e6
        self._battery_us = now_us
        return (
            *(
                now_us,
                battery.voltage_v,
                battery.current_a,
                -1.0,
                self._discharged_mah,
                battery.remaining,
                1.0,
                NAN,
                NAN,
            ),
            *([0.0] * 14),
            *(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
            *([0] * 9),
            *(True, 4, 0, 0, 1, False, False, 0),
        )

    def _outputs(self, now_us: int) -> Values:
        """PWM of PX4's simulator: 1000 to 2000 us, 900 while disarmed."""
        signals = self._autopilot.motors
        armed = self._autopilot.armed
        pulses = [1000.0 + 1000.0 * signal if armed else 900.0 for signal in signals][:16]
        return now_us, *pulses, *[0.0] * (16 - len(pulses)), len(pulses)

    def _allocator(self, now_us: int) -> Values:
        parameters = self._vehicle.parameters
        if parameters.revision != self._inverse_revision:
            self._inverse_revision = parameters.revision
            self._inverse = mix_of(parameters).inverse
        count = self._inverse.shape[1]
        state = self._autopilot.state
        motors = state["motors"][0, :count]
        roll, pitch, yaw, thrust = (self._inverse @ motors).tolist()
        p, q, r = state["torque_sp"][0].tolist()
        missing = (p - roll, q - pitch, r - yaw) if self._autopilot.armed else (0.0, 0.0, 0.0)
        lift = thrust - self._autopilot.control.thrust_sp if self._autopilot.armed else 0.0
        saturated = [2 if value >= 1.0 else -2 if value <= 0.0 else 0 for value in motors.tolist()]
        return (
            *(now_us, *missing, 0.0, 0.0, lift, 0, 0),
            *(sum(axis * axis for axis in missing) < _ACHIEVED, lift * lift < _ACHIEVED),
            *(saturated + [0] * (16 - count)),
        )

    def _manual(self, now_us: int) -> Values | None:
        sticks = self._sticks()
        if sticks is None:
            return None
        axes = (sticks.roll, sticks.pitch, sticks.yaw, sticks.throttle)
        return now_us, now_us, *axes, *[NAN] * 7, 0, True, 2, False, 0, 0
