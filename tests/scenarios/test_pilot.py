"""The pilot with a vehicle in the same thread that the test can lay hands on."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from bridge.client import Client
from bridge.clock import SimClock
from bridge.connection import Connection
from bridge.drive import SharedDrive
from bridge.link import MemoryLink
from bridge.vehicle_server import ServerLink, VehicleServer
from scenarios.manoeuvres import make_manoeuvre
from scenarios.pilot import FlightLog, Pilot
from scenarios.scenario import Gate, Scenario
from sitl.modes import Mode
from sitl.rotation import from_euler
from sitl.vehicle import Vehicle


class Cockpit:
    """A vehicle with its own flight gains, a client, a pilot; `at` does something when a phase begins."""

    def __init__(
        self, scenario: Scenario, at: dict[str, Callable[[Cockpit], object]] | None = None, **parameters: float | int
    ) -> None:
        model = scenario.resolve_vehicle()
        self.vehicle = Vehicle(model, scenario.resolve_profile(), seed=1)
        own = model.airframe.flight_gains
        assert own is not None
        for axis in ("ROLL", "PITCH"):
            values = {f"{axis}_P": own.k_phi, f"{axis}RATE_P": own.kp, f"{axis}RATE_I": own.ki, f"{axis}RATE_D": own.kd}
            for name, value in values.items():
                self.vehicle.parameters.set(f"MC_{name}", value)
        for name, number in parameters.items():
            self.vehicle.parameters.set(name, number)
        clock = SimClock(self.vehicle.tick_us)
        near, far = MemoryLink.pair()
        server = VehicleServer(
            self.vehicle, [ServerLink(far, Connection(1, 1, datagram=True), 0, "memory")], strict=True
        )
        clock.every_tick(server.step)
        self.sent: list[tuple[int, tuple[float, ...]]] = []
        self.clock = clock
        self.client = Client(near, SharedDrive(clock))
        self.phases: list[str] = []
        self.said: list[str] = []
        self._at = at or {}
        self.pilot = Pilot(self.client, scenario, lambda _severity, text: self.said.append(text), self._phase)
        self.client.connect()
        for message_id in (30, 83):
            self.client.set_interval(message_id, 20_000)
        self.client.wait_ready()

    def fly(self) -> FlightLog:
        self.pilot.fly()
        return self.pilot.log

    def _phase(self, name: str) -> None:
        self.phases.append(name)
        self._at.get(name, lambda _: None)(self)


def soon(seconds: float, act: Callable[[Cockpit], object]) -> Callable[[Cockpit], None]:
    """Do something to the vehicle a while after a phase began."""

    def arrange(cockpit: Cockpit) -> None:
        due = cockpit.clock.tick + round(seconds * 1e6 / cockpit.clock.tick_us)
        cockpit.clock.every_tick(lambda: act(cockpit) if cockpit.clock.tick == due else None)

    return arrange


def test_a_flight_goes_up_flies_its_manoeuvres_and_comes_down(quick_scenario: Any) -> None:
    step = make_manoeuvre("step", amplitude_deg=5.0, hold_s=1.0, return_s=1.0)
    ramp = make_manoeuvre("ramp", amplitude_deg=5.0, rate_deg_s=50.0, hold_s=0.1, return_s=0.0)
    cockpit = Cockpit(quick_scenario(manoeuvres=(step, ramp)))
    log = cockpit.fly()
    cockpit.pilot.come_down(may_force=False)
    assert (log.failure, log.notes) == ("", [])
    assert cockpit.phases == ["take off", "step", "ramp", "land"]
    assert [segment.name for segment in log.segments] == ["step/1", "step/2", "ramp"]
    assert [segment.kind for segment in log.segments] == ["step", "hold", "track"]
    first, second, track = log.segments
    assert first.end_s == pytest.approx(second.start_s)
    assert first.end_s - first.start_s == pytest.approx(1.0)
    assert second.phi_from_rad == pytest.approx(math.radians(5.0))
    assert track.end_s - track.start_s == pytest.approx(ramp.duration_s)
    assert not cockpit.vehicle.autopilot.armed
    assert abs(cockpit.vehicle.truth.position_ned()[2]) < 0.1
    assert cockpit.client.background is None


def test_set_points_are_flown_on_the_ticks_of_the_manoeuvre(quick_scenario: Any) -> None:
    """Sample k is the vehicle's set-point from k periods after the start on, not a tick earlier or later."""
    signal = make_manoeuvre(
        "multisine", peak_deg=10.0, duration_s=2.0, frequencies_hz=[0.7, 1.9], phases_rad=[0.0, 1.0], return_s=0.0
    )
    cockpit = Cockpit(quick_scenario(manoeuvres=(signal,)))
    flown: list[tuple[int, float]] = []

    def look() -> None:
        w, x, y, z = cockpit.vehicle.autopilot.attitude_sp.quat
        flown.append((cockpit.clock.now_us(), math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))))

    cockpit.clock.every_tick(look)
    log = cockpit.fly()
    start_us = round(log.segments[0].start_s * 1e6)
    tick_us = cockpit.clock.tick_us
    phi = dict(flown)
    for k, wanted in enumerate(signal.samples(50.0)):
        # sent at k periods, it is in force when the vehicle has taken the tick that follows
        assert phi[start_us + 20_000 * k + tick_us] == pytest.approx(wanted, abs=1e-6)
        assert phi[start_us + 20_000 * (k + 1)] == pytest.approx(wanted, abs=1e-6)


def test_the_gate_is_waited_for(quick_scenario: Any) -> None:
    """A step begins level, still and at height for as long as the gate says."""
    gate = Gate(level_deg=1.0, rate_deg_s=2.0, height_m=0.3, hold_s=1.5, timeout_s=20.0)
    cockpit = Cockpit(quick_scenario(gate=gate))
    seen: list[tuple[float, float, float, float]] = []

    def look() -> None:
        estimate = cockpit.vehicle.estimate
        phi, theta, _ = estimate.euler()
        tilt = math.degrees(max(abs(phi), abs(theta)))
        rate = math.degrees(max(abs(r) for r in estimate.rates()))
        seen.append((cockpit.clock.now_us() * 1e-6, tilt, rate, abs(estimate.position_ned()[2] + 3.0)))

    cockpit.clock.every_tick(look)
    log = cockpit.fly()
    assert not log.notes
    start_s = log.segments[0].start_s
    before = np.array([row for row in seen if start_s - 1.45 < row[0] <= start_s])
    assert (before[:, 1] <= 1.1).all()
    assert (before[:, 2] <= 2.5).all()
    assert (before[:, 3] <= 0.35).all()


def test_a_gate_that_never_opens_is_a_note_and_the_manoeuvre_is_flown(quick_scenario: Any) -> None:
    gate = Gate(level_deg=0.0001, hold_s=0.5, timeout_s=1.0)
    log = Cockpit(quick_scenario(gate=gate)).fly()
    assert len(log.segments) == 2
    assert log.notes == ["step: not level, still and at height within 1 s; flown all the same"]


def test_height_is_kept_through_a_steep_step_by_a_vehicle_of_any_hover_thrust(quick_scenario: Any) -> None:
    for hover in (0.2, 0.5, 0.65):
        for sign in (1, -1):
            steep = make_manoeuvre("step", amplitude_deg=sign * 45.0, hold_s=2.0, return_s=1.0)
            cockpit = Cockpit(quick_scenario(assumptions={"hover_thrust": hover}, manoeuvres=(steep,)))
            heights: list[float] = []
            cockpit.clock.every_tick(lambda c=cockpit, h=heights: h.append(-c.vehicle.truth.position_ned()[2]))
            log = cockpit.fly()
            assert not log.failure
            start = round(log.segments[0].start_s * 1e6 / cockpit.clock.tick_us)
            assert abs(min(heights[start:]) - 3.0) < 0.6
            assert abs(max(heights[start:]) - 3.0) < 0.6


class TestEndsEarly:
    """What becomes of the vehicle in flight is a result, with a reason that a person understands."""

    def test_disarmed(self, quick_scenario: Any) -> None:
        strike = soon(0.5, lambda c: c.vehicle.autopilot.command_arm(False, force=True))
        cockpit = Cockpit(quick_scenario(), {"step": strike})
        log = cockpit.fly()
        assert log.failure.startswith("the vehicle disarmed in flight: Disarmed by external command")
        cockpit.pilot.come_down(may_force=False)
        assert "land" not in cockpit.phases

    def test_taken_over_by_somebody_else(self, quick_scenario: Any) -> None:
        strike = soon(3.5, lambda c: c.vehicle.autopilot.command_mode(Mode.LOITER))
        log = Cockpit(quick_scenario(), {"step": strike}).fly()
        assert log.failure.startswith("the vehicle left Offboard")
        assert log.failure.endswith("in step")

    def test_set_points_that_stay_out_are_named(self, quick_scenario: Any) -> None:
        """As when the computer stands still, or flies a vehicle faster than it can follow."""
        cockpit = Cockpit(quick_scenario())

        def stand_still() -> None:
            if cockpit.said[-1:] == ["step begins"]:
                cockpit.client.background = lambda now_us: now_us + 20_000

        cockpit.clock.every_tick(stand_still)
        log = cockpit.fly()
        assert log.failure.startswith("the vehicle left Offboard")
        assert "no set-point for 1." in log.failure
        assert log.failure.endswith("of its time: computer or link did not keep up) in step")

    def test_what_was_measured_until_then_is_kept_with_its_true_end(self, quick_scenario: Any) -> None:
        def strike(cockpit: Cockpit) -> None:
            if cockpit.said == ["step begins"]:
                cockpit.said.append("armed")
                soon(1.0, lambda c: c.vehicle.autopilot.command_arm(False, force=True))(cockpit)

        cockpit = Cockpit(quick_scenario())
        cockpit.clock.every_tick(lambda: strike(cockpit))
        log = cockpit.fly()
        assert [segment.name for segment in log.segments] == ["step/1"]
        # the heartbeat that tells it comes once a second
        assert 1.0 <= log.segments[0].end_s - log.segments[0].start_s < 2.0

    def test_lost_height(self, quick_scenario: Any) -> None:
        cockpit = Cockpit(quick_scenario(), {"step": soon(2.5, lambda c: setattr(c.pilot, "_hover_thrust", 0.1))})
        log = cockpit.fly()
        assert log.failure.startswith("lost height: ")
        assert "of 3 m" in log.failure

    def test_turned_over(self, quick_scenario: Any) -> None:
        turned = from_euler(math.radians(170.0), 0.0, 0.0)
        strike = soon(0.5, lambda c: c.vehicle.plant.x.__setitem__(slice(6, 10), turned))
        cockpit = Cockpit(quick_scenario(), {"step": strike})
        log = cockpit.fly()
        assert log.failure.startswith("diverged: tilt beyond 80 deg")

    def test_never_leaves_the_ground(self, quick_scenario: Any) -> None:
        log = Cockpit(quick_scenario(), MPC_THR_MAX=0.3, MPC_THR_HOVER=0.2).fly()
        assert log.failure.startswith("take-off failed: 0.0 m of 3 m reached in 60 s")

    def test_not_allowed_to_arm(self, quick_scenario: Any) -> None:
        cockpit = Cockpit(quick_scenario())
        cockpit.vehicle.parameters.set("CA_ROTOR_COUNT", 0)
        cockpit.client.wait(0.1)
        log = cockpit.fly()
        assert log.failure.startswith("arm: temporarily rejected by the vehicle: Preflight Fail: no usable rotor")
        assert cockpit.phases == ["take off"]

    def test_not_allowed_into_offboard(self, quick_scenario: Any) -> None:
        cockpit = Cockpit(quick_scenario(), COM_OF_LOSS_T=0.0)
        assert cockpit.fly().failure.startswith("mode Offboard: temporarily rejected by the vehicle")
        cockpit.pilot.come_down(may_force=False)
        assert not cockpit.vehicle.autopilot.armed
        assert not cockpit.pilot.log.notes


class TestComingDown:
    def test_a_vehicle_of_our_own_that_cannot_land_is_stopped(self, quick_scenario: Any) -> None:
        cockpit = Cockpit(quick_scenario(manoeuvres=()), MPC_LAND_SPEED=0.0)
        cockpit.fly()
        cockpit.pilot.come_down(may_force=True)
        assert not cockpit.vehicle.autopilot.armed
        assert cockpit.pilot.log.failure == "did not land and disarm within 90 s"
        assert cockpit.pilot.log.notes == ["could not land; motors were stopped"]

    def test_the_motors_of_anothers_vehicle_are_never_stopped_in_the_air(self, quick_scenario: Any) -> None:
        cockpit = Cockpit(quick_scenario(manoeuvres=()), MPC_LAND_SPEED=0.0)
        cockpit.fly()
        cockpit.pilot.come_down(may_force=False)
        assert cockpit.vehicle.autopilot.armed
        assert cockpit.pilot.log.notes == ["the vehicle is still armed: take over and land it by hand"]


def test_set_points_keep_coming_at_any_rate(quick_scenario: Any) -> None:
    for rate_hz in (5.0, 250.0):
        step = make_manoeuvre("step", amplitude_deg=10.0, hold_s=1.0, return_s=0.0, setpoint_rate_hz=rate_hz)
        cockpit = Cockpit(quick_scenario(setpoint_rate_hz=rate_hz, manoeuvres=(step,)))
        counts: list[tuple[int, int]] = []
        autopilot = cockpit.vehicle.autopilot
        cockpit.clock.every_tick(
            lambda c=cockpit, n=counts, a=autopilot: n.append((c.clock.now_us(), a.attitude_sp_count))
        )
        log = cockpit.fly()
        start_us = round(log.segments[0].start_s * 1e6)
        during = [count for time_us, count in counts if start_us < time_us <= start_us + 1_000_000]
        assert during[-1] - during[0] == pytest.approx(rate_hz, abs=1.5)
