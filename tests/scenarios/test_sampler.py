"""Rows of telemetry out of messages, one by one."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scenarios.flight import Segment
from scenarios.sampler import ROWS_PER_BATCH, Columns, Sampler, Truth
from scenarios.telemetry import NO_SEGMENT
from sitl.rotation import from_euler

INVERSE = np.array([[-0.5, 0.5, 0.5, -0.5], [0.5, -0.5, 0.5, -0.5]])


class Wire:
    """Stands in for a client: hands messages to whoever subscribed, in the order that PX4 sends them."""

    def __init__(
        self, inverse: Any = INVERSE, on_batch: Callable[[Columns], object] | None = None, **options: Any
    ) -> None:
        self.state = SimpleNamespace(nav_state=14, armed=True)
        self._handlers: dict[str, Callable[[Any], None]] = {}
        self.sampler = Sampler(self, inverse, on_batch, **options)  # type: ignore[arg-type]

    def subscribe(self, name: str, handler: Callable[[Any], None]) -> None:
        self._handlers[name] = handler

    def attitude(self, t_ms: int, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0, p: float = 0.0) -> None:
        self._say("ATTITUDE", time_boot_ms=t_ms, roll=roll, pitch=pitch, yaw=yaw, rollspeed=p, pitchspeed=0, yawspeed=0)

    def target(self, phi: float = 0.0, theta: float = 0.0, psi: float = 0.0, thrust: float = 0.5) -> None:
        quat = from_euler(phi, theta, psi)
        self._say("ATTITUDE_TARGET", q=quat, body_roll_rate=1.0, body_pitch_rate=2.0, body_yaw_rate=3.0, thrust=thrust)

    def position(self, north: float) -> None:
        self._say("LOCAL_POSITION_NED", x=north, y=0.0, z=-3.0, vx=0.1, vy=0.2, vz=0.3)

    def motors(self, *signals: float) -> None:
        self._say("HIL_ACTUATOR_CONTROLS", controls=(*signals, *(0.0 for _ in range(16 - len(signals)))))

    def truth(self, p: float, phi: float = 0.0) -> None:
        quat = from_euler(phi, 0.0, 0.0)
        self._say("HIL_STATE_QUATERNION", attitude_quaternion=quat, rollspeed=p, pitchspeed=0.0, yawspeed=0.0)

    def telemetry(self, segments: tuple[Segment, ...] = ()) -> Any:
        return self.sampler.telemetry(segments)

    def _say(self, name: str, **fields: Any) -> None:
        self._handlers[name](SimpleNamespace(**fields))


def test_a_row_is_an_attitude_with_all_that_came_in_its_tick() -> None:
    wire = Wire()
    wire.attitude(4, roll=0.1, p=0.5)
    wire.target(phi=0.2)
    wire.position(1.0)
    wire.motors(0.4, 0.6, 0.6, 0.4)
    wire.attitude(8, roll=0.3)
    rows = wire.telemetry()
    assert rows["t_s"].tolist() == [0.004, 0.008]
    assert rows["phi_rad"].tolist() == pytest.approx([0.1, 0.3])
    assert rows["phi_sp_rad"].tolist() == pytest.approx([0.2, 0.2])  # held until the next one comes
    assert rows["north_m"].tolist() == [1.0, 1.0]
    assert rows["motor2"].tolist() == pytest.approx([0.6, 0.6])
    assert rows["delta_lat"].tolist() == pytest.approx([0.2, 0.2])
    assert rows["p_sp_rad_s"].tolist() == [1.0, 1.0]
    assert rows["nav_state"].tolist() == [14, 14]
    assert rows["armed"].all()


def test_what_was_never_reported_is_nan() -> None:
    wire = Wire()
    wire.attitude(4)
    rows = wire.telemetry()
    for name in ("phi_sp_rad", "thrust_sp", "down_m", "motor1", "motor4", "motor5", "delta_lat", "delta_lon"):
        assert np.isnan(rows[name]).all(), name


def test_true_rates_are_taken_in_their_own_tick_only() -> None:
    wire = Wire()
    wire.attitude(4, p=0.5)
    wire.truth(0.7, phi=0.3)
    wire.attitude(8, p=0.6)
    rows = wire.telemetry()
    assert rows["p_rad_s"].tolist() == pytest.approx([0.7, 0.6])
    assert rows["phi_true_rad"].tolist() == pytest.approx([0.3, math.nan], nan_ok=True)


def test_a_plant_of_ours_is_asked_for_the_tick_that_the_vehicle_reports() -> None:
    wire = Wire()
    known = {8: Truth(from_euler(-0.2, 0.1, 1.0), (0.7, 0.0, 0.1), (0.1, 0.2, 0.3, 0.4))}
    wire.sampler.truth_at = known.get
    wire.attitude(4, roll=-0.1, p=0.5)
    wire.attitude(8, roll=-0.19, p=0.6)
    rows = wire.telemetry()
    assert rows["phi_true_rad"].tolist() == pytest.approx([math.nan, -0.2], nan_ok=True)
    assert rows["theta_true_rad"][1] == pytest.approx(0.1)
    assert rows["psi_true_rad"][1] == pytest.approx(1.0)
    assert rows["p_rad_s"].tolist() == pytest.approx([0.5, 0.7])
    assert rows["motor3"].tolist() == pytest.approx([math.nan, 0.3], nan_ok=True)


def test_an_attitude_out_of_order_is_left_out() -> None:
    wire = Wire()
    for t_ms in (4, 8, 8, 6, 12):
        wire.attitude(t_ms)
    assert wire.telemetry()["t_s"].tolist() == [0.004, 0.008, 0.012]


@given(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))
def test_set_point_angles_are_those_of_the_quaternion(phi: float, theta: float, psi: float) -> None:
    wire = Wire()
    wire.attitude(4)
    wire.target(phi, theta, psi)
    rows = wire.telemetry()
    found = [float(rows[name][0]) for name in ("phi_sp_rad", "theta_sp_rad", "psi_sp_rad")]
    assert found == pytest.approx([phi, theta, psi], abs=2e-6)


def test_every_row_goes_out_once_in_batches_and_comes_back_in_the_telemetry() -> None:
    batches: list[Columns] = []
    wire = Wire(on_batch=batches.append)
    count = 2 * ROWS_PER_BATCH + 17
    for k in range(count):
        wire.attitude(4 * (k + 1), roll=math.sin(k))
    rows = wire.telemetry()
    assert [len(batch["t_s"]) for batch in batches] == [ROWS_PER_BATCH, ROWS_PER_BATCH, 17]
    assert np.array_equal(np.concatenate([batch["t_s"] for batch in batches]), rows["t_s"])
    assert len(rows) == count
    again = wire.telemetry()  # asking twice changes nothing
    assert again.sha256() == rows.sha256()


def test_rows_of_a_vehicle_elsewhere_wait_for_a_moment_only_however_few_they_are() -> None:
    batches: list[Columns] = []
    wire = Wire(on_batch=batches.append, batch_s=0.06)
    times_ms = [*range(4, 1000, 4), *range(1000, 3000, 20), 5000, 5004]
    for t_ms in times_ms:
        wire.attitude(t_ms)
        handed_over = batches[-1]["t_s"][-1] if batches else 0.0
        finished = [one for one in times_ms if one < t_ms]
        assert (finished[-1] if finished else 0) * 1e-3 - handed_over < 0.0601
    assert max(len(batch["t_s"]) for batch in batches) == 16
    rows = wire.telemetry()["t_s"]
    assert np.array_equal(np.concatenate([batch["t_s"] for batch in batches]), rows)
    assert rows.tolist() == pytest.approx([one / 1000 for one in times_ms])


def test_rows_belong_to_the_segment_they_are_in() -> None:
    wire = Wire()
    for k in range(1, 11):
        wire.attitude(100 * k)
    segments = (
        Segment("a", "step", "a", 0.2, 0.4, 0.1, 0.0),
        Segment("b", "hold", "a", 0.4, 0.5, 0.1, 0.0),
        Segment("c", "track", "c", 0.8, 9.0, 0.1, 0.0),
    )
    assert wire.telemetry(segments)["segment"].tolist() == [NO_SEGMENT, 0, 0, 1, *[NO_SEGMENT] * 3, 2, 2, 2]


def test_no_messages_no_rows() -> None:
    assert len(Wire().telemetry()) == 0


@pytest.mark.parametrize("count", [0, 3, 6, 8, 12])
def test_any_number_of_motors(count: int) -> None:
    """The first eight are shown, all of them count for delta."""
    inverse = np.ones((2, count)) / max(count, 1)
    wire = Wire(inverse)
    wire.attitude(4)
    wire.motors(*(0.5 for _ in range(count)))
    rows = wire.telemetry()
    assert [bool(np.isfinite(rows[f"motor{n + 1}"][0])) for n in range(8)] == [n < count for n in range(8)]
    assert float(rows["delta_lat"][0]) == pytest.approx(0.5 if count else 0.0)
