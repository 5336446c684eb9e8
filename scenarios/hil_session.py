"""A real autopilot on our plant, for a whole run: the simulator's port, the MAVLink link, the truth of every tick."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from types import TracebackType
from typing import Self

from bridge.clock import WallClock
from bridge.hil_drive import HilDrive
from bridge.link import open_link
from bridge.lockstep import Lockstep, LockstepReport
from bridge.simulator import Simulator
from scenarios.sampler import Truth
from sitl.body import Body
from sitl.errors import UsageError
from sitl.parameters import ParameterType
from sitl.profile import Profile
from sitl.vehicle_spec import VehicleModel

HISTORY_TICKS = 2048
"""Ticks whose truth is kept for an ATTITUDE that comes late; eight seconds."""

QUAD_MOTORS = 4
"""Motors whose outputs every PX4 build for simulators has assigned."""

_FIRST_MOTOR_FUNCTION = 101
_LOOK_TICKS = 250


class HilSession:
    """Plant and links of a run; a context manager.

    Args:
        simulator_url: where the autopilot's simulator link connects, `tcpin://127.0.0.1:4560`.
        connect_url: its MAVLink, `udpin://127.0.0.1:14540`.
        model, profile: the plant. seed: of the sensors' noise.
        say: called with a line for people.

    Attributes:
        body: the plant. link: the client's. drive: the client's time. lockstep: how the two keep step.

    Raises:
        UsageError: a simulator link that is no TCP.
        LinkError: a port is taken.
    """

    board = False

    def __init__(
        self,
        simulator_url: str,
        connect_url: str,
        model: VehicleModel,
        profile: Profile,
        *,
        seed: int = 0,
        say: Callable[[str], object] = lambda _: None,
    ) -> None:
        if not simulator_url.startswith("tcp"):
            raise UsageError(f"--hil {simulator_url}: lockstep needs TCP, such as tcpin://127.0.0.1:4560")
        self._stack = ExitStack()
        self.body = Body(model, profile, seed=seed)
        simulator = Simulator(self.body, truth=True)
        with ExitStack() as opening:
            self._port = opening.enter_context(open_link(simulator_url))
            self.link = opening.enter_context(open_link(connect_url))
            self._stack = opening.pop_all()
        self.lockstep = Lockstep(self._port, simulator, say=say)
        self.drive = HilDrive(self.lockstep)
        self.drive.each_tick = self._keep
        self._truth: dict[int, Truth] = {}
        self._sampled = self._now()
        self._clock = WallClock()
        self._began_us = self._flown_us = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    @property
    def report(self) -> LockstepReport:
        """How plant and autopilot kept step."""
        return self.lockstep.report

    @property
    def faults(self) -> tuple[str, ...]:
        """What makes this flight worthless."""
        return tuple(self.report.faults or ())

    @property
    def answers(self) -> int:
        """Motor commands that came since `begin`."""
        return self.report.answered

    @property
    def motors(self) -> tuple[float, ...]:
        """The latest motor commands."""
        return self.lockstep.motors

    def begin(self) -> None:
        """Another flight begins: its report is its own."""
        self.lockstep.report = LockstepReport()
        self._began_us, self._flown_us = self._clock.now_us(), self.body.time_us

    @property
    def speed(self) -> float:
        """Vehicle seconds per second of this flight so far."""
        return (self.body.time_us - self._flown_us) / max(1, self._clock.now_us() - self._began_us)

    def summary(self) -> str:
        """How the two kept step, in a line."""
        report = self.report
        return (
            f"lockstep: {report.answered} of {report.steps} ticks answered, longest wait "
            f"{1e3 * report.longest_wait_s:.0f} ms, {self.speed:.1f} x real time"
        )

    def truth_at(self, time_ms: int) -> Truth | None:
        """What the plant did at a vehicle time.

        Args:
            time_ms: as in ATTITUDE.
        """
        return self._truth.get(time_ms)

    def _now(self) -> tuple[int, tuple[float, float, float, float], tuple[float, float, float]]:
        return self.body.time_us // 1000, self.body.truth.quat(), self.body.truth.rates()

    def _keep(self) -> None:
        if self.report.steps % _LOOK_TICKS == 0:
            self.drive.alive()
        # the motors are those that answered the sample of the tick before: they belong to its state
        time_ms, quat, rates = self._sampled
        self._truth[time_ms] = Truth(quat, rates, self.lockstep.motors)
        self._sampled = self._now()
        if len(self._truth) > HISTORY_TICKS:
            del self._truth[next(iter(self._truth))]


def geometry_parameters(model: VehicleModel, *, board: bool = False) -> dict[str, tuple[float | int, ParameterType]]:
    """What a real autopilot must know of the airframe: rotors, and outputs for those beyond four.

    Args:
        model: whose body flies.
        board: hardware, which assigns its outputs by HIL_ACT_FUNCn; a simulator's build by PWM_MAIN_FUNCn.

    Returns:
        name -> (value, type).
    """
    rotors = model.airframe.rotors
    real: ParameterType = "REAL32"
    whole: ParameterType = "INT32"
    values: dict[str, tuple[float | int, ParameterType]] = {}
    for n, rotor in enumerate(rotors):
        for what, value in (("PX", rotor.px_m), ("PY", rotor.py_m), ("PZ", rotor.pz_m), ("KM", rotor.km)):
            values[f"CA_ROTOR{n}_{what}"] = value, real
    if len(rotors) != QUAD_MOTORS:
        values["CA_ROTOR_COUNT"] = len(rotors), whole
    function = "HIL_ACT_FUNC" if board else "PWM_MAIN_FUNC"
    for n in range(0 if board else QUAD_MOTORS, len(rotors)):
        values[f"{function}{n + 1}"] = _FIRST_MOTOR_FUNCTION + n, whole
    return values
