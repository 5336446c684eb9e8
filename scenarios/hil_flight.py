"""What a flight with a real autopilot does beyond one with our own: look before it arms, watch the motors."""

from __future__ import annotations

from collections.abc import Callable

from bridge.client import Client
from bridge.errors import NotReady
from scenarios.hil_check import must_fly, why_no_thrust, why_not_ready
from scenarios.motor_watch import LIMIT_US, MotorWatch
from scenarios.plant_session import PlantSession
from sitl.vehicle_spec import VehicleModel


def make_ready(client: Client, session: PlantSession, model: VehicleModel, timeout_s: float) -> None:
    """Find what keeps the autopilot from flying, then wait until it would arm.

    Args:
        client: connected. session: whose plant is being stepped. model: the airframe on it.
        timeout_s: vehicle time for getting ready, s.

    Raises:
        HilUnfit: with every finding and its remedy.
    """
    must_fly(client, session, model)
    try:
        client.make_ready(timeout_s)
    except NotReady as error:
        raise why_not_ready(client, session, model, error) from error


def motor_watch(client: Client, session: PlantSession, model: VehicleModel) -> Callable[[], None]:
    """Something to call fifty times a second in flight: raises HilUnfit when motors stand that ought to turn.

    Args:
        client, session, model: as `make_ready`.
    """
    watch = MotorWatch(len(model.airframe.rotors))

    def look() -> None:
        if not client.state.armed:
            return
        standing = watch.standing(client.now_us(), session.motors, client.state.thrust_sp)
        if standing:
            raise why_no_thrust(client, session, model, standing, LIMIT_US * 1e-6)

    return look
