"""Sticks over MAVLink: a joystick's MANUAL_CONTROL and a radio's RC_CHANNELS_OVERRIDE."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sitl.modes import Mode

INT16_MAX = 32767
KEEP, RELEASE = 65535, 65534
RC_ONLY, JOYSTICK_ONLY, FALLBACK, KEEP_FIRST, DISABLED = range(5)


def joystick(one: Any, link: int = 0, **axes: int) -> tuple[float, ...] | None:
    """Send one MANUAL_CONTROL; return roll, pitch, yaw, throttle as the autopilot has them."""
    one.grounds[link].send("MANUAL_CONTROL", **{"target": 1, **axes})
    one.run(0.004)
    sticks = one.autopilot.manual.sticks
    return None if sticks is None else tuple(sticks)


def radio(one: Any, *widths: int, **fields: Any) -> tuple[float, ...] | None:
    """Send one RC_CHANNELS_OVERRIDE; channels left out are not said anything of."""
    channels = {f"chan{number}_raw": KEEP for number in range(1, 9)}
    channels |= {f"chan{number}_raw": width for number, width in enumerate(widths, start=1)}
    one.ground.send("RC_CHANNELS_OVERRIDE", **{"target_system": 1, "target_component": 1, **channels, **fields})
    one.run(0.004)
    sticks = one.autopilot.manual.sticks
    return None if sticks is None else tuple(sticks)


@pytest.fixture
def one(on_ground: Any) -> Any:
    """On the ground, with the four sticks on channels 1 to 4, all sources welcome."""
    for number, name in enumerate(("ROLL", "PITCH", "YAW", "THROTTLE"), start=1):
        on_ground.vehicle.parameters.set(f"RC_MAP_{name}", number)
    on_ground.vehicle.parameters.set("COM_RC_IN_MODE", FALLBACK)
    return on_ground


class TestJoystick:
    @pytest.mark.parametrize(
        ("axes", "sticks"),
        [
            ({"z": 500}, (0, 0, 0, 0)),
            ({"y": 1000, "z": 500}, (1, 0, 0, 0)),
            ({"x": 1000, "z": 500}, (0, 1, 0, 0)),
            ({"r": -250, "z": 500}, (0, 0, -0.25, 0)),
            ({"z": 1000}, (0, 0, 0, 1)),
            ({"z": 0}, (0, 0, 0, -1)),
            ({"x": -1000, "y": -500, "r": 125, "z": 250}, (-0.5, -1, 0.125, -0.5)),
            ({"x": 32766, "y": -32768, "z": -1000}, (-1, 1, 0, -1)),
            ({"x": INT16_MAX, "y": INT16_MAX, "r": INT16_MAX, "z": INT16_MAX}, (0, 0, 0, -1)),
        ],
    )
    def test_axes(self, one: Any, axes: dict[str, int], sticks: tuple[float, ...]) -> None:
        assert joystick(one, **axes) == pytest.approx(sticks)

    @pytest.mark.parametrize("target", [0, 2, 255])
    def test_of_another_vehicle(self, one: Any, target: int) -> None:
        assert joystick(one, target=target, z=500) is None
        assert one.server.refused == 0

    def test_falls_silent(self, one: Any) -> None:
        assert joystick(one, z=500) is not None
        one.run(float(one.vehicle.parameters.get("COM_RC_LOSS_T")) + 0.02)
        assert one.autopilot.manual.sticks is None

    def test_the_first_keeps_the_vehicle(self, flight: Any) -> None:
        both = flight("gcs", "onboard")
        both.run(3.0)
        assert joystick(both, 0, y=300, z=500) == pytest.approx((0.3, 0, 0, 0))
        assert joystick(both, 1, y=-900, z=500) == pytest.approx((0.3, 0, 0, 0))
        assert both.server.refused == 1
        both.run(1.0)
        assert joystick(both, 1, y=-900, z=500) == pytest.approx((-0.9, 0, 0, 0))

    def test_flies(self, flight: Any) -> None:
        one = flight().hover()

        def right() -> None:
            if one.vehicle.tick % 13 == 0:
                one.ground.send("MANUAL_CONTROL", target=1, y=600, z=500)

        one.run(0.1, right)
        assert one.result(176, 1, 3) == 0
        assert one.autopilot.mode is Mode.POSCTL
        one.run(2.0, right)
        assert one.vehicle.truth.velocity_body()[1] > 1.0

    def test_moved_it_takes_over_from_hold(self, flight: Any) -> None:
        one = flight().hover()
        one.run(0.2, one.at_20_hz(lambda: one.ground.send("MANUAL_CONTROL", target=1, z=500)))
        assert one.autopilot.mode is Mode.LOITER
        one.run(0.2, one.at_20_hz(lambda: one.ground.send("MANUAL_CONTROL", target=1, x=900, z=500)))
        assert one.autopilot.mode is Mode.POSCTL
        assert "Pilot took over using sticks\t" in one.ground.texts()


class TestRadio:
    @pytest.mark.parametrize(
        ("widths", "sticks"),
        [
            ((1500, 1500, 1500, 1500), (0, 0, 0, 0)),
            ((2000, 1000, 1750, 1000), (1, -1, 0.5, -1)),
            ((2400, 100, 1500, 65535 - 2), (1, -1, 0, 1)),
        ],
    )
    def test_pulse_widths(self, one: Any, widths: tuple[int, ...], sticks: tuple[float, ...]) -> None:
        assert radio(one, *widths) == pytest.approx(sticks)
        assert one.server.refused == 0

    def test_channels_are_mapped(self, one: Any) -> None:
        for name, channel in (("ROLL", 4), ("PITCH", 12), ("YAW", 18), ("THROTTLE", 1)):
            one.vehicle.parameters.set(f"RC_MAP_{name}", channel)
        extension = {"chan12_raw": 1250, "chan18_raw": 2000}
        assert radio(one, 1900, 1000, 1000, 1750, **extension) == pytest.approx((0.5, -0.5, 1, 0.8))

    def test_without_a_map_there_are_no_sticks(self, on_ground: Any) -> None:
        on_ground.vehicle.parameters.set("COM_RC_IN_MODE", RC_ONLY)
        assert radio(on_ground, 1500, 1500, 1500, 1500) is None
        assert on_ground.server.refused == 1

    def test_one_more_stick_than_channels(self, one: Any) -> None:
        one.vehicle.parameters.set("RC_MAP_YAW", 19)
        assert radio(one, 1500, 1500, 1500, 1500) is None

    def test_scaling_and_reverse(self, one: Any) -> None:
        for name, value in (("MIN", 1100), ("TRIM", 1400), ("MAX", 1900), ("REV", -1)):
            one.vehicle.parameters.set(f"RC1_{name}", value)
            one.vehicle.parameters.set(f"RC4_{name}", value)
        # a throttle has no middle of its own: half way is zero
        assert radio(one, 1900, 1500, 1500, 1100) == pytest.approx((-1, 0, 0, 1))
        assert radio(one, 1650, 1500, 1500, 1500) == pytest.approx((-0.5, 0, 0, 0))
        assert radio(one, 1250, 1500, 1500, 1900) == pytest.approx((0.5, 0, 0, -1))

    @pytest.mark.parametrize(("low", "trim", "high"), [(1500, 1500, 1500), (2000, 1500, 1000), (1000, 2000, 2000)])
    def test_a_range_of_nothing_is_the_middle_or_an_end(self, one: Any, low: int, trim: int, high: int) -> None:
        for name, value in (("MIN", low), ("TRIM", trim), ("MAX", high)):
            one.vehicle.parameters.set(f"RC1_{name}", value)
        sticks = radio(one, 1700, 1500, 1500, 1500)
        assert sticks is not None
        assert -1.0 <= sticks[0] <= 1.0

    def test_what_a_message_leaves_out_stays(self, one: Any) -> None:
        radio(one, 2000, 1500, 1500, 1500)
        assert radio(one, KEEP, 1750) == pytest.approx((1, 0.5, 0, 0))

    def test_a_channel_that_is_released_is_silent(self, one: Any) -> None:
        radio(one, 1500, 1500, 1500, 1500)
        refused = one.server.refused
        radio(one, 0)
        assert one.server.refused == refused + 1
        one.run(1.0)
        assert one.autopilot.manual.sticks is None

    def test_zero_in_the_extension_says_nothing_and_65534_releases(self, one: Any) -> None:
        one.vehicle.parameters.set("RC_MAP_ROLL", 10)
        assert radio(one, 1500, 1500, 1500, 1500, chan10_raw=2000) == pytest.approx((1, 0, 0, 0))
        assert radio(one, 1500, 1500, 1500, 1500) == pytest.approx((1, 0, 0, 0))
        radio(one, 1500, 1500, 1500, 1500, chan10_raw=RELEASE)
        assert one.server.refused == 1
        one.run(1.0)
        assert one.autopilot.manual.sticks is None

    @pytest.mark.parametrize("target", [(2, 1), (1, 99)])
    def test_of_another_vehicle(self, one: Any, target: tuple[int, int]) -> None:
        assert radio(one, 1500, 1500, 1500, 1500, target_system=target[0], target_component=target[1]) is None
        assert radio(one, 1500, 1500, 1500, 1500, target_system=0, target_component=0) is not None

    def test_is_shown_while_it_lasts(self, one: Any) -> None:
        def send() -> None:
            one.ground.send("RC_CHANNELS_OVERRIDE", target_system=1, target_component=1, chan1_raw=1111, chan9_raw=1999)

        one.forget()
        one.run(0.3)
        assert one.ground.named("RC_CHANNELS") == []
        one.run(1.0, one.at_20_hz(send))
        shown = one.ground.named("RC_CHANNELS")
        assert len(shown) == pytest.approx(20, abs=2)
        assert (shown[-1].chancount, shown[-1].chan1_raw, shown[-1].chan2_raw, shown[-1].chan9_raw) == (
            18,
            1111,
            0,
            1999,
        )
        one.run(0.52)
        one.forget()
        one.run(0.5)
        assert one.ground.named("RC_CHANNELS") == []


class TestChoice:
    @pytest.mark.parametrize(
        ("mode", "by_joystick", "by_radio"),
        [
            (RC_ONLY, False, True),
            (JOYSTICK_ONLY, True, False),
            (FALLBACK, True, True),
            (KEEP_FIRST, True, False),  # even when the first has fallen silent
            (DISABLED, False, False),
        ],
    )
    def test_who_may_fly(self, one: Any, mode: int, by_joystick: bool, by_radio: bool) -> None:
        one.vehicle.parameters.set("COM_RC_IN_MODE", mode)
        assert (joystick(one, z=500) is not None) == by_joystick
        one.run(1.0)
        assert (radio(one, 1500, 1500, 1500, 1500) is not None) == by_radio
        assert one.server.refused == (not by_joystick) + (not by_radio)

    def test_the_other_one_takes_over_when_the_first_is_silent(self, one: Any) -> None:
        assert joystick(one, z=1000) == pytest.approx((0, 0, 0, 1))
        assert radio(one, 2000, 1500, 1500, 1500) == pytest.approx((0, 0, 0, 1))
        one.run(1.0)
        assert radio(one, 2000, 1500, 1500, 1500) == pytest.approx((1, 0, 0, 0))


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    widths=st.lists(st.integers(0, 65535), min_size=18, max_size=18),
    limits=st.tuples(*[st.floats(width=32)] * 3),
    sign=st.integers(-(2**31), 2**31 - 1),
    throttle=st.integers(-5, 25),
)
def test_sticks_stay_within_their_range(
    one: Any, widths: list[int], limits: tuple[float, ...], sign: int, throttle: int
) -> None:
    table = one.vehicle.parameters
    table.set("RC_MAP_THROTTLE", throttle)
    table.set("RC2_REV", sign)
    for name, value in zip(("MIN", "TRIM", "MAX"), limits, strict=True):
        table.set(f"RC2_{name}", value)
    sticks = radio(one, *widths[:8], **{f"chan{number + 9}_raw": width for number, width in enumerate(widths[8:])})
    assert sticks is None or all(-1.0 <= stick <= 1.0 for stick in sticks)
