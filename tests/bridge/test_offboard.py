"""Set-points of an offboard computer: what of each message reaches the autopilot, and what it does with it."""

from __future__ import annotations

import math
from typing import Any

import pytest

from sitl.modes import Mode
from sitl.sensors import geodetic
from sitl.setpoints import PositionRequest

NAN = math.nan
LOCAL, GLOBAL = "SET_POSITION_TARGET_LOCAL_NED", "SET_POSITION_TARGET_GLOBAL_INT"
ROLL_RATE, PITCH_RATE, YAW_RATE, THRUST_BODY, THRUST, ATTITUDE = 1, 2, 4, 32, 64, 128
X, Y, Z, VX, VY, VZ, AX, AY, AZ, FORCE, YAW, TURN = (1 << bit for bit in range(12))
POSITION, VELOCITY, ACCELERATION = X | Y | Z, VX | VY | VZ, AX | AY | AZ
US = {"target_system": 1, "target_component": 1}


class Listening:
    """A vehicle on the ground whose autopilot only notes what it is asked for."""

    def __init__(self, one: Any, monkeypatch: pytest.MonkeyPatch) -> None:
        self.one = one
        self.attitudes: list[tuple[Any, ...]] = []
        self.positions: list[PositionRequest] = []
        monkeypatch.setattr(one.autopilot, "offboard_attitude", lambda *what: self.attitudes.append(what))
        monkeypatch.setattr(one.autopilot, "offboard_position", self.positions.append)

    def send(self, name: str, **fields: Any) -> None:
        self.one.ground.send(name, **{**US, **fields})
        self.one.server.listen()

    def position(self, name: str, **fields: Any) -> PositionRequest | None:
        """Send a position set-point; return what arrives."""
        self.positions.clear()
        self.send(name, **fields)
        assert len(self.positions) <= 1
        return self.positions[0] if self.positions else None

    @property
    def refused(self) -> int:
        refused: int = self.one.server.refused
        return refused


@pytest.fixture
def heard(on_ground: Any, monkeypatch: pytest.MonkeyPatch) -> Listening:
    return Listening(on_ground, monkeypatch)


def same(seen: Any, wanted: Any) -> bool:
    """Equal as float32, NaN where NaN is wanted."""
    result: bool = tuple(seen) == pytest.approx(tuple(wanted), rel=1e-6, abs=1e-6, nan_ok=True)
    return result


class TestAttitude:
    @pytest.mark.parametrize("low", range(0, 256, 32))
    def test_every_mask(self, heard: Listening, low: int) -> None:
        fields = {
            "q": (0.8, 0.6, 0.0, 0.0),
            "body_roll_rate": 0.1,
            "body_pitch_rate": 0.2,
            "body_yaw_rate": 0.3,
            "thrust": 0.4,
            "thrust_body": (0.0, 0.3, -0.4),
        }
        for mask in range(low, low + 32):
            heard.attitudes.clear()
            heard.send("SET_ATTITUDE_TARGET", type_mask=mask, **fields)
            if mask & ATTITUDE and mask & (ROLL_RATE | PITCH_RATE):
                assert heard.attitudes == [], mask
                continue
            ((quat, rates, thrust),) = heard.attitudes
            assert quat is None if mask & ATTITUDE else same(quat, fields["q"])
            bits = (ROLL_RATE, PITCH_RATE, YAW_RATE)
            wanted = [NAN if mask & bit else rate for bit, rate in zip(bits, (0.1, 0.2, 0.3), strict=True)]
            assert same(rates, wanted), mask
            assert thrust == pytest.approx(0.0 if mask & THRUST else 0.5 if mask & THRUST_BODY else 0.4), mask
        assert heard.refused == 0

    def test_what_the_mask_ignores_may_be_anything(self, heard: Listening) -> None:
        heard.send("SET_ATTITUDE_TARGET", type_mask=7, q=(1, 0, 0, 0), body_roll_rate=NAN, body_yaw_rate=math.inf)
        heard.send("SET_ATTITUDE_TARGET", type_mask=ATTITUDE | THRUST, q=(NAN, 0, 0, 0), thrust=NAN)
        heard.send("SET_ATTITUDE_TARGET", type_mask=7 | THRUST_BODY, q=(1, 0, 0, 0), thrust=NAN)
        assert (len(heard.attitudes), heard.refused) == (3, 0)

    def test_only_if_set_points_are_forwarded(self, heard: Listening) -> None:
        heard.one.vehicle.parameters.set("MAV_FWDEXTSP", 0)
        heard.send("SET_ATTITUDE_TARGET", type_mask=7, q=(1, 0, 0, 0))
        assert heard.position(LOCAL, coordinate_frame=1) is None
        assert heard.position(GLOBAL, coordinate_frame=5) is None
        assert (heard.attitudes, heard.refused) == ([], 0)


class TestLocal:
    FIELDS: dict[str, float] = {  # noqa: RUF012 - constant
        **{"x": 1.0, "y": 2.0, "z": -3.0},
        **{"vx": 0.25, "vy": 0.5, "vz": -0.75},
        **{"afx": 4.0, "afy": 5.0, "afz": -6.0},
        **{"yaw": 0.125, "yaw_rate": 0.0625},
    }

    def test_every_mask(self, heard: Listening) -> None:
        bits = (X, Y, Z, VX, VY, VZ, AX, AY, AZ, YAW, TURN)
        for mask in range(0, 4096, 5):
            request = heard.position(LOCAL, coordinate_frame=1, type_mask=mask, **self.FIELDS)
            if mask & FORCE or mask & 511 == 511:
                assert request is None, mask
                continue
            assert request is not None, mask
            seen = (*request.position_ned, *request.velocity_ned, *request.acceleration_ned, *request[3:])
            wanted = [NAN if mask & bit else value for bit, value in zip(bits, self.FIELDS.values(), strict=True)]
            assert same(seen, wanted), mask

    def test_what_is_no_number_is_as_if_masked(self, heard: Listening) -> None:
        request = heard.position(LOCAL, coordinate_frame=1, x=NAN, y=math.inf, z=-2.0, vz=-math.inf, yaw=NAN)
        assert request is not None
        assert same(request.position_ned, (NAN, NAN, -2.0))
        assert same(request.velocity_ned, (0.0, 0.0, NAN))
        assert math.isnan(request.yaw)

    def test_nothing_but_what_is_no_number(self, heard: Listening) -> None:
        nothing = dict.fromkeys(("x", "y", "z", "vx", "vy", "vz", "afx", "afy", "afz"), NAN)
        assert heard.position(LOCAL, coordinate_frame=1, **nothing) is None
        assert heard.refused == 1

    def test_in_the_body_s_frame_x_is_forward(self, heard: Listening, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(heard.one.vehicle.estimate, "euler", lambda: (0.0, 0.0, math.pi / 2))
        request = heard.position(LOCAL, coordinate_frame=8, **self.FIELDS)
        assert request is not None
        assert same(request.position_ned, (NAN, NAN, NAN))
        assert same(request.velocity_ned, (-0.5, 0.25, -0.75))
        assert same(request.acceleration_ned, (-5.0, 4.0, -6.0))

    def test_a_place_in_the_body_s_frame_is_none(self, heard: Listening) -> None:
        assert heard.position(LOCAL, coordinate_frame=8, type_mask=VELOCITY | ACCELERATION, x=5.0) is None
        assert heard.refused == 1

    @pytest.mark.parametrize("frame", [0, 2, 3, 5, 6, 7, 9, 12, 20, 255])
    def test_other_frames_are_refused_in_words(self, heard: Listening, frame: int) -> None:
        assert heard.position(LOCAL, coordinate_frame=frame, **self.FIELDS) is None
        heard.one.run(0.02)
        assert heard.one.ground.texts() == [f"{LOCAL} coordinate frame {frame} unsupported\t"]
        assert heard.refused == 1

    @pytest.mark.parametrize("target", [(9, 1), (1, 99)])
    def test_of_another_vehicle(self, heard: Listening, target: tuple[int, int]) -> None:
        to = {"target_system": target[0], "target_component": target[1]}
        assert heard.position(LOCAL, coordinate_frame=1, **self.FIELDS, **to) is None
        assert heard.refused == 0
        everybody = {"target_system": 0, "target_component": 0}
        assert heard.position(LOCAL, coordinate_frame=1, **self.FIELDS, **everybody) is not None


class TestGlobal:
    NORTH_EAST_DOWN = (100.0, -50.0, -12.0)

    def place(self, alt: float) -> dict[str, Any]:
        lat, lon, _ = geodetic(self.NORTH_EAST_DOWN)
        return {"lat_int": round(lat * 1e7), "lon_int": round(lon * 1e7), "alt": alt}

    @pytest.mark.parametrize(("frame", "alt"), [(0, 500.0), (5, 500.0), (3, 12.0), (6, 12.0)])
    def test_above_sea_level_or_home(self, heard: Listening, frame: int, alt: float) -> None:
        request = heard.position(GLOBAL, coordinate_frame=frame, **self.place(alt), vx=1.0, afz=2.0, yaw=0.5)
        assert request is not None
        assert request.position_ned == pytest.approx(self.NORTH_EAST_DOWN, abs=0.05)
        assert (request.velocity_ned, request.acceleration_ned) == ((1.0, 0.0, 0.0), (0.0, 0.0, 2.0))
        assert (request.yaw, request.yaw_rate) == (0.5, 0.0)

    def test_home_counts_and_not_where_the_vehicle_booted(self, heard: Listening) -> None:
        assert heard.one.result(179, 0, 0, 0, NAN, 47.4, 8.5, 588.0) == 0
        request = heard.position(GLOBAL, coordinate_frame=6, **self.place(12.0))
        assert request is not None
        assert request.position_ned[2] == pytest.approx(-112.0, abs=0.05)

    @pytest.mark.parametrize(
        ("mask", "free"), [(X, [0]), (Y, [1]), (Z, [2]), (POSITION, [0, 1, 2]), (X | Y | YAW | TURN, [0, 1])]
    )
    def test_masks(self, heard: Listening, mask: int, free: list[int]) -> None:
        request = heard.position(GLOBAL, coordinate_frame=5, type_mask=mask, **self.place(500.0), yaw=0.5)
        assert request is not None
        assert [axis for axis in range(3) if math.isnan(request.position_ned[axis])] == free
        assert math.isnan(request.yaw) == math.isnan(request.yaw_rate) == bool(mask & YAW)

    def test_a_height_that_is_no_number_is_free(self, heard: Listening) -> None:
        request = heard.position(GLOBAL, coordinate_frame=5, **self.place(NAN))
        assert request is not None
        assert math.isnan(request.position_ned[2])
        assert math.isfinite(request.position_ned[0])

    @pytest.mark.parametrize(("frame", "fields"), [(5, {"type_mask": FORCE}), (6, {"type_mask": 511})])
    def test_invalid(self, heard: Listening, frame: int, fields: dict[str, int]) -> None:
        assert heard.position(GLOBAL, coordinate_frame=frame, **self.place(10.0), **fields) is None
        heard.one.run(0.02)
        assert heard.one.ground.texts() == [f"{GLOBAL} invalid\t"]

    @pytest.mark.parametrize("frame", [1, 2, 4, 8, 10, 11, 255])
    def test_other_frames_are_refused_in_words(self, heard: Listening, frame: int) -> None:
        assert heard.position(GLOBAL, coordinate_frame=frame, **self.place(10.0)) is None
        heard.one.run(0.02)
        assert heard.one.ground.texts() == [f"{GLOBAL} coordinate frame {frame} unsupported\t"]
        assert heard.refused == 1

    @pytest.mark.parametrize("lat_int", [-(2**31), 2**31 - 1])
    @pytest.mark.parametrize("alt", [-3e38, 3e38, math.inf])
    def test_places_that_are_none_do_not_break_it(self, flight: Any, lat_int: int, alt: float) -> None:
        one = flight()
        one.run(2.1)
        one.result(176, 1, 6)
        fields = {**US, "coordinate_frame": 5, "lat_int": lat_int, "lon_int": lat_int, "alt": alt}
        one.run(0.1, lambda: one.ground.send(GLOBAL, **fields))
        assert one.result(400, 1) == 0
        one.run(0.3, lambda: one.ground.send(GLOBAL, **fields))
        assert all(map(math.isfinite, one.vehicle.truth.position_ned()))


@pytest.mark.parametrize("name", [LOCAL, GLOBAL])
@pytest.mark.parametrize("fields", [{"coordinate_frame": 4}, {"coordinate_frame": 5 - 4, "type_mask": 0x1FF}])
def test_a_stream_of_refused_ones_is_said_once_a_second(on_ground: Any, name: str, fields: dict[str, int]) -> None:
    on_ground.forget()
    on_ground.run(2.9, on_ground.at_20_hz(lambda: on_ground.ground.send(name, **US, **fields)))
    assert len(on_ground.ground.texts()) == 3
    assert len(on_ground.ground.named("EVENT")) == 3
    assert on_ground.server.refused == pytest.approx(56, abs=2)


class TestFlown:
    def fly(self, flight: Any, seconds: float, **fields: Any) -> Any:
        one = flight().hover()

        def send() -> None:
            one.ground.send(LOCAL, **{**US, "coordinate_frame": 1, **fields})

        one.run(0.2, one.at_20_hz(send))
        assert one.result(176, 1, 6) == 0
        one.run(seconds, one.at_20_hz(send))
        assert one.autopilot.mode is Mode.OFFBOARD
        return one

    def test_a_place_is_flown_to_and_shown(self, flight: Any) -> None:
        mask = VELOCITY | ACCELERATION | YAW | TURN
        one = self.fly(flight, 8.0, type_mask=mask, x=4.0, y=-3.0, z=-7.0)
        assert one.vehicle.truth.position_ned() == pytest.approx((4.0, -3.0, -7.0), abs=0.3)
        target = one.ground.named("POSITION_TARGET_LOCAL_NED")[-1]
        assert (target.x, target.y, target.z) == (4.0, -3.0, -7.0)
        assert target.type_mask & POSITION == 0

    def test_a_velocity_in_the_body_s_frame(self, flight: Any) -> None:
        mask = POSITION | ACCELERATION | YAW
        one = self.fly(flight, 4.0, coordinate_frame=8, type_mask=mask, vx=1.5, vz=-0.5)
        u, v, _ = one.vehicle.truth.velocity_body()
        assert (u, v) == pytest.approx((1.5, 0.0), abs=0.25)
        assert one.vehicle.truth.velocity_ned()[2] == pytest.approx(-0.5, abs=0.15)

    def test_refused_ones_do_not_keep_offboard(self, flight: Any) -> None:
        one = self.fly(flight, 0.2, type_mask=VELOCITY | ACCELERATION, z=-5.0)
        one.run(1.5, one.at_20_hz(lambda: one.ground.send(LOCAL, **US, coordinate_frame=9)))
        assert one.autopilot.mode is not Mode.OFFBOARD
