"""Flies one scenario with whatever gains are on the vehicle: take-off, ready gate, manoeuvres, landing.

The vehicle is judged in Offboard attitude mode: Hold and Take-off feed the side force of the motors back through the
velocity controller and are another loop. Between manoeuvres Hold stops the vehicle, then Offboard waits until it is
level, still and at height.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from bridge.client import Client
from bridge.errors import CommandRefused, PeerSilent
from scenarios.flight import Segment
from scenarios.limits import LIMIT_CYCLE_RAD_S
from scenarios.manoeuvres import EPSILON_S, Manoeuvre
from scenarios.metrics import DIVERGED_RAD
from scenarios.sampler import CRUISE_INTERVAL_US, FAST_INTERVAL_US, SAMPLED
from scenarios.scenario import Scenario
from sitl.modes import LandedState, Mode
from sitl.rotation import from_euler

TAKEOFF_TIMEOUT_S = 60.0
STOP_TIMEOUT_S = 15.0
LAND_TIMEOUT_S = 90.0
STOPPED_M_S = 0.15
LEAST_HEIGHT_M = 1.0
HOVER_AVERAGE_S = 1.0

_HEIGHT_GAIN_1_M = 0.10
_CLIMB_GAIN_S_M = 0.18
_THRUST_MIN, _THRUST_MAX = 0.05, 0.98
_CHECK_US = 20_000
_PAUSE_US = 300_000
"""Longest time without a set-point that is not told: a PX4 leaves Offboard after COM_OF_LOSS_T, by default 1 s."""
_LATELY_US = 3_000_000


class FlightEndedError(Exception):
    """The flight cannot go on: a result of the candidate, not a fault of the harness. The text is the reason."""


@dataclass
class FlightLog:
    """What the pilot did.

    Attributes:
        segments: measured parts, in order of time.
        failure: why the flight ended early; empty if it did not.
        notes: what a reader of the result must know, such as a gate that was not reached.
    """

    segments: list[Segment] = field(default_factory=list)
    failure: str = ""
    notes: list[str] = field(default_factory=list)


class Pilot:
    """One flight.

    Args:
        client: connected, vehicle ready, gains uploaded, streams set.
        scenario: what to fly.
        say: called with (severity, text) for the event log.
        progress: called with a short text at every phase.
        sampled: ids of the messages that are wanted fast while something is measured.
    """

    def __init__(
        self,
        client: Client,
        scenario: Scenario,
        say: Callable[[int, str], object],
        progress: Callable[[str], object],
        sampled: Sequence[int] = SAMPLED,
    ) -> None:
        self._sampled = sampled
        self.watch: Callable[[], object] = lambda: None
        """Called fifty times a second from take-off on; what it raises ends the flight."""
        self.began: Callable[[str], object] = lambda _: None
        """Called with a manoeuvre's name at its first set-point, and with "" when the take-off is under way."""
        self.over: Callable[[], object] = lambda: None
        """Called when the last manoeuvre is over, or the flight has ended before."""
        self.excuses_silence: Callable[[], bool] = lambda: False
        """Asked when the vehicle does not answer: is that the flight's own doing, whose link was made to fail?"""
        self._client = client
        self._scenario = scenario
        self._say = say
        self._progress = progress
        self.log = FlightLog()
        self._period_us = round(1e6 / scenario.setpoint_rate_hz)
        self._next_us = 0
        self._sent_us = self._paused_us = 0
        self._signal: np.ndarray = np.zeros(0)
        self._signal_start_us = 0
        self._hover_thrust = 0.5
        self._psi = 0.0
        self._down = 0.0
        self._watching = False
        self._next_check_us = 0

    def fly(self) -> None:
        """Take off and fly every manoeuvre; `log` tells what became of it. Land with `come_down` afterwards."""
        try:
            self._take_off()
            for manoeuvre in self._scenario.manoeuvres:
                self._progress(manoeuvre.name)
                self._stop()
                self._into_offboard()
                self._gate(manoeuvre)
                self._sample_every(FAST_INTERVAL_US)
                self._manoeuvre(manoeuvre)
                self._sample_every(CRUISE_INTERVAL_US)
        except (FlightEndedError, CommandRefused, PeerSilent) as end:
            if isinstance(end, PeerSilent) and not self.excuses_silence():
                raise
            self.log.failure = str(end)
            self._say(2, f"flight ended: {end}")
        finally:
            self._client.background = None
            self._watching = False
            self.over()

    def come_down(self, *, may_force: bool) -> None:
        """Land and disarm, whatever happened before.

        Args:
            may_force: stop the motors of a vehicle that cannot land; only for a simulated one.
        """
        client = self._client
        if not client.state.armed:
            return
        self._progress("land")
        lost = bool(self.log.failure) and self._tilt() > math.radians(60.0)
        if not lost:
            client.land()
            if client.wait_until(lambda: not client.state.armed, LAND_TIMEOUT_S):
                return
        if may_force:
            client.disarm(force=True)
            client.wait_until(lambda: not client.state.armed, 3.0)
            self.log.notes.append("could not land; motors were stopped")
            if not self.log.failure:
                self.log.failure = f"did not land and disarm within {LAND_TIMEOUT_S:g} s"
        else:
            self.log.notes.append("the vehicle is still armed: take over and land it by hand")
            self._say(0, "the vehicle is still armed: take over and land it by hand")

    # -- phases ------------------------------------------------------------------------------------------------

    def _take_off(self) -> None:
        client, height = self._client, self._scenario.takeoff_altitude_m
        self._progress("take off")
        if client.state.position_ned is None:
            raise FlightEndedError("no position to take off from")
        ground = client.state.position_ned[2]
        self._down = ground - height
        client.arm()
        client.takeoff(height)
        self._watching = True
        self.began("")

        def there() -> bool:
            self._check(least_height_m=-math.inf)
            position = client.state.position_ned
            return client.state.nav_state == Mode.LOITER and position is not None and position[2] < self._down + 1.0

        if not client.wait_until(there, TAKEOFF_TIMEOUT_S):
            position = client.state.position_ned
            reached = ground - position[2] if position else 0.0
            raise FlightEndedError(
                f"take-off failed: {reached:.1f} m of {height:g} m reached in {TAKEOFF_TIMEOUT_S:g} s{self._shaking()}"
            )

    def _stop(self) -> None:
        """Hold position until the vehicle stands still, then learn the thrust that carries it."""
        client = self._client
        client.background = None
        if client.state.nav_state != Mode.LOITER:
            client.set_mode(Mode.LOITER)
        if not client.wait_until(self._stopped, STOP_TIMEOUT_S):
            self.log.notes.append(f"did not stop in Hold within {STOP_TIMEOUT_S:g} s{self._shaking()}")
        thrusts: list[float] = []

        def listen() -> bool:
            self._check()
            thrusts.append(client.state.thrust_sp)
            return False

        client.wait_until(listen, HOVER_AVERAGE_S)
        self._hover_thrust = min(0.95, max(0.05, float(np.mean(thrusts))))
        self._psi = client.state.euler[2] if client.state.euler else 0.0

    def _stopped(self) -> bool:
        self._check()
        velocity, position = self._client.state.velocity_ned, self._client.state.position_ned
        if velocity is None or position is None:
            return False
        return math.sqrt(sum(v * v for v in velocity)) < STOPPED_M_S and abs(position[2] - self._down) < 1.0

    def _into_offboard(self) -> None:
        client = self._client
        self._signal = np.zeros(0)
        self._next_us = self._sent_us = client.now_us()
        self._paused_us = 0
        client.background = self._stream
        client.wait(0.2)
        client.set_mode(Mode.OFFBOARD)
        if not client.wait_until(lambda: client.state.nav_state == Mode.OFFBOARD, 3.0):
            raise FlightEndedError("the vehicle accepted Offboard and did not enter it")

    def _sample_every(self, interval_us: int) -> None:
        for message_id in self._sampled:
            self._client.try_interval(message_id, interval_us)

    def _gate(self, manoeuvre: Manoeuvre) -> None:
        gate = self._scenario.gate
        quiet_since: list[int] = []

        def ready() -> bool:
            self._check()
            state = self._client.state
            now = self._client.now_us()
            if state.euler is None or state.rates is None or state.position_ned is None:
                return False
            quiet = (
                max(abs(state.euler[0]), abs(state.euler[1])) <= math.radians(gate.level_deg)
                and max(abs(rate) for rate in state.rates) <= math.radians(gate.rate_deg_s)
                and abs(state.position_ned[2] - self._down) <= gate.height_m
            )
            if not quiet:
                quiet_since.clear()
                return False
            if not quiet_since:
                quiet_since.append(now)
            return now - quiet_since[0] >= gate.hold_s * 1e6

        if not self._client.wait_until(ready, gate.timeout_s):
            note = (
                f"{manoeuvre.name}: not level, still and at height within {gate.timeout_s:g} s{self._shaking()}; "
                "flown all the same"
            )
            self.log.notes.append(note)
            self._say(4, note)

    def _manoeuvre(self, manoeuvre: Manoeuvre) -> None:
        client = self._client
        start_us = client.now_us()
        self._signal = manoeuvre.samples(self._scenario.setpoint_rate_hz)
        self._signal_start_us = start_us
        self._next_us = start_us
        start_s = start_us * 1e-6
        self.began(manoeuvre.name)
        self._say(6, f"{manoeuvre.name} begins")
        end_us = start_us + round(manoeuvre.duration_s * 1e6)
        ended = ""
        try:
            while client.now_us() < end_us:
                client.pump(end_us)
                self._check()
        except FlightEndedError as end:
            ended = str(end)
        now_s = client.now_us() * 1e-6
        several = len(manoeuvre.windows) > 1
        for n, window in enumerate(manoeuvre.windows, 1):
            if ended and start_s + window.start_s >= now_s:
                break
            self.log.segments.append(
                Segment(
                    name=f"{manoeuvre.name}/{n}" if several else manoeuvre.name,
                    kind=window.kind,
                    manoeuvre=manoeuvre.name,
                    start_s=start_s + window.start_s,
                    end_s=min(start_s + window.end_s, now_s) if ended else start_s + window.end_s,
                    amplitude_rad=window.phi_to_rad - (0.0 if window.kind == "track" else window.phi_from_rad),
                    phi_from_rad=window.phi_from_rad,
                )
            )
        self._signal = np.zeros(0)
        self._say(6, f"{manoeuvre.name} ends")
        if ended:
            raise FlightEndedError(f"{ended} in {manoeuvre.name}")

    # -- set-points and watching -------------------------------------------------------------------------------

    def _stream(self, now_us: int) -> int:
        """Send the set-point that is due: sample k of the manoeuvre from k periods after its start on, or level.

        Returns:
            vehicle time of the next one, us.
        """
        if now_us < self._next_us:
            return self._next_us
        self._paused_us = max(self._paused_us, now_us - self._sent_us)
        self._sent_us = now_us
        elapsed = now_us - self._signal_start_us
        index = int(elapsed / self._period_us + EPSILON_S)
        phi_sp = float(self._signal[index]) if index < len(self._signal) else 0.0
        self._next_us = (
            self._signal_start_us + (index + 1) * self._period_us if len(self._signal) else now_us + self._period_us
        )
        self._client.attitude_setpoint(from_euler(phi_sp, 0.0, self._psi), self._thrust())
        return self._next_us

    def _thrust(self) -> float:
        state = self._client.state
        phi, theta = (state.euler[0], state.euler[1]) if state.euler else (0.0, 0.0)
        climb = state.velocity_ned[2] if state.velocity_ned else 0.0
        below = state.position_ned[2] - self._down if state.position_ned else 0.0
        upright = max(0.5, math.cos(phi) * math.cos(theta))
        thrust = self._hover_thrust / upright * (1.0 + _HEIGHT_GAIN_1_M * below + _CLIMB_GAIN_S_M * climb)
        return min(_THRUST_MAX, max(_THRUST_MIN, thrust))

    def _tilt(self) -> float:
        euler = self._client.state.euler
        return max(abs(euler[0]), abs(euler[1])) if euler else 0.0

    def _check(self, least_height_m: float = LEAST_HEIGHT_M) -> None:
        """End the flight if it is none any more; looks fifty times a second, however often it is asked."""
        now_us = self._client.now_us()
        if not self._watching or now_us < self._next_check_us:
            return
        self._next_check_us = now_us + _CHECK_US
        self.watch()
        state = self._client.state
        if self._tilt() > DIVERGED_RAD:
            raise FlightEndedError(f"diverged: tilt beyond {math.degrees(DIVERGED_RAD):g} deg")
        if not state.armed and state.landed_state != LandedState.UNDEFINED:
            raise FlightEndedError("the vehicle disarmed in flight" + self._last_words())
        height = self._scenario.takeoff_altitude_m - (state.position_ned[2] - self._down) if state.position_ned else 0.0
        if height < least_height_m:
            left, of = max(0.0, height), self._scenario.takeoff_altitude_m
            raise FlightEndedError(f"lost height: {left:.1f} m left of {of:g} m")
        if self._client.background is not None and len(self._signal) and state.nav_state != Mode.OFFBOARD:
            raise FlightEndedError("the vehicle left Offboard" + self._last_words())

    def _shaking(self) -> str:
        rates = self._client.state.rates
        fastest = max(abs(rate) for rate in rates) if rates else 0.0
        return "" if fastest < LIMIT_CYCLE_RAD_S else f" (shaking: rates up to {fastest:.1f} rad/s)"

    def _last_words(self) -> str:
        """What the vehicle said lately, and whether we gave it a reason."""
        now_us = self._client.now_us()
        since_us, paused_us = now_us - _LATELY_US, max(self._paused_us, now_us - self._sent_us)
        said = [text for time_us, _, text in self._client.state.texts if time_us >= since_us]
        paused = ""
        if self._client.background is not None and paused_us > _PAUSE_US:
            paused = f" (no set-point for {paused_us * 1e-6:.1f} s of its time: computer or link did not keep up)"
        return (f": {said[-1]}" if said else "") + paused
