"""A flight control with a commander of a few lines, so that its modes can be flown alone."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

from sitl.control_settings import mix_of
from sitl.flight_control import FlightControl
from sitl.land_detector import LandDetector, LandLimits, Motion
from sitl.modes import Home, Mode
from sitl.parameters import ParameterTable
from sitl.plan import NAV_TAKEOFF, NAV_WAYPOINT, MissionItem
from sitl.plant import Plant
from sitl.profile import get_profile
from sitl.rotation import to_euler
from sitl.sensors import Sensors, geodetic
from sitl.setpoints import PositionRequest, Sticks
from sitl.vehicle import airframe_parameters
from sitl.vehicle_spec import resolve_vehicle

NAN = math.nan
NAN3 = (NAN, NAN, NAN)


class Flown:
    """One armed vehicle on the ground at the origin, spooled up."""

    def __init__(self, mode: Mode = Mode.LOITER, **parameters: float) -> None:
        model, profile = resolve_vehicle("ant-x"), get_profile("sitl")
        self.parameters = ParameterTable(airframe_parameters(model, profile))
        gains = model.airframe.flight_gains
        assert gains is not None
        for axis in ("ROLL", "PITCH"):
            self.parameters.set(f"MC_{axis}_P", gains.k_phi)
            for suffix, value in (("P", gains.kp), ("I", gains.ki), ("D", gains.kd)):
                self.parameters.set(f"MC_{axis}RATE_{suffix}", value)
        for name, value in parameters.items():
            self.parameters.set(name, value)
        self.plant = Plant(
            model.derivatives,
            model.assumptions,
            mix_of(self.parameters),
            tick_us=profile.tick_us,
            motor_lag_s=profile.motor_lag(model.assumptions.motor_lag_s),
            delay_ticks=profile.transport_delay_ticks,
            linear=profile.linear,
        )
        self.sensors = Sensors(self.plant, profile, 1)
        self.control = FlightControl(self.parameters, profile, self.plant, self.sensors)
        self.landing = LandDetector()
        self.tick_us = profile.tick_us
        self.now_us = 0
        self.texts: list[str] = []
        self.mode = mode
        self.home = Home(*geodetic((0.0, 0.0, 0.0)), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
        self.hover = model.assumptions.hover_thrust
        self.limits = LandLimits(0.12, self.hover, 0.08, 0.25, 1.5, math.radians(20.0))
        self.tilt_max_deg = 0.0
        self.control.navigator.on_arm(0)
        self.begin(mode)
        self.outputs = self.control.run()

    def begin(self, mode: Mode) -> None:
        """Switch."""
        before, self.mode = self.mode, mode
        self.control.begin(self.now_us, mode, before, home=self.home, landed=self.landing.landed)
        if mode is Mode.TAKEOFF:
            self.texts += [text.text for text in self.control.navigator.aim(None)]

    def _command(self) -> None:
        control, landing = self.control, self.landing
        if not landing.flies(control.thrust_sp, self.limits):
            held = control.climb_controlled
            fx, fy, fz = self.plant.force.tolist()
            p, q, r = control.state["rates"][0].tolist()
            n, e, d = control.velocity.tolist()
            descending = held and control.navigator.descending
            motion = Motion(control.thrust_sp, (n, e, d), (p, q, r), (fx, fy, fz), held, descending)
            landing.update(self.now_us, motion, self.limits, True)
            control.set_landed(landing.maybe_landed)
        wish = control.wish
        if wish is not None:
            self.begin(wish)

    def step(self) -> None:
        """One tick."""
        self.plant.step(self.outputs)
        self.now_us += self.tick_us
        self.sensors.sample(self.now_us)
        if self.now_us % 12_000 < self.tick_us:
            self._command()
        self.outputs = self.control.run()
        if self.mode is not Mode.OFFBOARD or self.control.by_position:
            self.control.guide(self.now_us, self.mode, self.landing, self.home)
        self.texts += [text.text.removesuffix("\t") for text in self.control.take_texts()]

    def run(self, seconds: float) -> None:
        """Fly on."""
        for _ in range(round(seconds * 1e6 / self.tick_us)):
            self.step()
            phi, theta, _ = self.euler_deg
            self.tilt_max_deg = max(self.tilt_max_deg, math.hypot(phi, theta))

    def until(self, condition: Callable[[], bool], timeout_s: float) -> float:
        """Fly on until something holds; s it took."""
        start = self.now_us
        while not condition():
            assert self.now_us - start < timeout_s * 1e6, f"at {self.ned} in {self.mode.name}, said {self.texts}"
            self.run(0.02)
        return (self.now_us - start) * 1e-6

    def take_off(self, height_m: float = 10.0) -> None:
        """Up, and still."""
        self.parameters.set("MIS_TAKEOFF_ALT", height_m)
        self.begin(Mode.TAKEOFF)
        self.until(lambda: self.mode is Mode.LOITER, 60.0)
        self.run(3.0)
        self.tilt_max_deg = 0.0

    def offboard(self, **wanted: tuple[float, float, float] | float) -> None:
        """Ask for a position, velocity, acceleration, yaw or yaw rate."""
        values = {"position": NAN3, "velocity": NAN3, "acceleration": NAN3, "yaw": NAN, "yaw_rate": NAN, **wanted}
        request = PositionRequest(*values.values())  # type: ignore[arg-type]
        self.control.take_position(self.now_us, request, fly=True)
        if self.mode is not Mode.OFFBOARD:
            self.begin(Mode.OFFBOARD)

    @property
    def ned(self) -> tuple[float, float, float]:
        """Where it is, m."""
        return self.plant.position_ned()

    @property
    def velocity(self) -> tuple[float, float, float]:
        """NED, m/s."""
        return self.plant.velocity_ned()

    @property
    def euler_deg(self) -> tuple[float, float, float]:
        """Roll, pitch, heading."""
        phi, theta, psi = (math.degrees(angle) for angle in to_euler(tuple(self.plant.quat.tolist())))
        return phi, theta, psi

    def distance(self, n: float, e: float) -> float:
        """Horizontal, m."""
        return math.hypot(self.ned[0] - n, self.ned[1] - e)

    @staticmethod
    def item(
        command: int,
        ned: tuple[float, float, float] = (0.0, 0.0, 0.0),
        params: tuple[float, float, float, float] = (0.0, 0.0, 0.0, NAN),
        *,
        frame: int = 6,
        autocontinue: bool = True,
    ) -> MissionItem:
        """An item of a mission at a place given in the local frame."""
        lat, lon, amsl = geodetic(ned)
        return MissionItem(frame, command, autocontinue, params, lat, lon, amsl if frame in (0, 5) else -ned[2])

    @classmethod
    def rise(cls, height_m: float = 8.0) -> MissionItem:
        """Take-off above the origin."""
        return cls.item(NAV_TAKEOFF, (0.0, 0.0, -height_m))

    @classmethod
    def waypoint(cls, n: float, e: float, height_m: float, hold_s: float = 0.0, yaw_deg: float = NAN) -> MissionItem:
        """A place to pass."""
        return cls.item(NAV_WAYPOINT, (n, e, -height_m), (hold_s, 0.0, 0.0, yaw_deg))

    def fly_mission(self, *items: MissionItem) -> None:
        """Load and begin."""
        self.control.mission.load(items)
        self.begin(Mode.MISSION)


@pytest.fixture
def flown() -> type[Flown]:
    """The class to fly one of."""
    return Flown


@pytest.fixture
def ground(flight: Any) -> Any:
    """A whole vehicle on the ground, ready to arm."""
    made = flight()
    made.get_ready()
    assert [text for _, text in made.texts] == ["Preflight Fail: heading estimate invalid"]
    made.texts.clear()
    return made


@pytest.fixture
def hover(flight: Any) -> Any:
    """A whole vehicle in Hold at 10 m."""
    made = flight()
    made.take_off(10.0, settle_s=3.0)
    made.texts.clear()
    return made


@pytest.fixture
def offboard(flight: Any) -> Any:
    """A whole vehicle in Offboard at 10 m, with level set-points at 50 Hz while it runs with ``keep``."""
    made = flight()
    made.take_off(10.0, settle_s=2.0)
    made.go_offboard()
    made.keep = lambda k: made.autopilot.offboard_attitude((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, math.nan), 0.5)
    made.run(1.0, made.keep)
    made.texts.clear()
    return made


class Pilot:
    """Sticks on a joystick's link, sent at 20 Hz of vehicle time."""

    def __init__(self, flight: Any, source: int = 0) -> None:
        self.flight = flight
        self.source = source

    def send(self, sticks: Sticks) -> bool:
        """Once."""
        taken: bool = self.flight.autopilot.manual.take(self.flight.vehicle.time_us, self.source, sticks)
        return taken

    def fly(self, seconds: float, **sticks: float) -> None:
        """Hold the sticks somewhere."""
        every = max(1, 50_000 // self.flight.vehicle.tick_us)
        self.flight.run(seconds, lambda k: self.send(Sticks(**sticks)) if k % every == 0 else None)

    def fly_until(self, condition: Callable[[], bool], timeout_s: float, **sticks: float) -> float:
        """Hold the sticks somewhere until something holds, looked at every 100 ms; s it took."""
        start = self.flight.time_s
        while not condition():
            assert self.flight.time_s - start < timeout_s, f"not within {timeout_s} s; said {self.flight.texts}"
            self.fly(0.1, **sticks)
        took: float = self.flight.time_s - start
        return took


@pytest.fixture
def pilot() -> type[Pilot]:
    """The class to fly a whole vehicle by sticks with."""
    return Pilot
