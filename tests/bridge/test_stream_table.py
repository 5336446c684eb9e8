"""Streams that a PX4 has: those that come on request, those that wait for a device, and what they say."""

from __future__ import annotations

from typing import Any

import pytest

from bridge.messages import BY_NAME
from bridge.stream_table import DEFAULT_HZ, START_HZ, STREAMS

BOOT_UTC_US = 1_795_387_540_000_000
DISTANCE_SENSOR, FLIGHT_INFORMATION, UTM_GLOBAL_POSITION, HIGH_LATENCY2 = 132, 264, 340, 235


def ask(one: Any, command: int, *params: float, only: str) -> list[Any]:
    answers: list[Any] = one.command(command, *params, only=(only, "COMMAND_ACK"), wait_s=0.02)
    return answers


def test_the_table_agrees_with_the_dialect() -> None:
    for message_id, stream in STREAMS.items():
        assert BY_NAME[stream.name].id == message_id
    names = {stream.name for stream in STREAMS.values()}
    for rates in (*DEFAULT_HZ.values(), *START_HZ.values()):
        assert set(rates) <= names


def test_a_rate_can_be_set_for_what_has_no_device_and_nothing_comes(flight: Any) -> None:
    one = flight("gcs")
    one.run(0.1)
    (ack,) = ask(one, 511, DISTANCE_SENSOR, 100_000, only="DISTANCE_SENSOR")
    assert ack.result == 0
    (interval, ack) = one.command(510, DISTANCE_SENSOR, only=("MESSAGE_INTERVAL", "COMMAND_ACK"), wait_s=0.02)
    assert interval.interval_us == 100_000
    (ack,) = ask(one, 512, DISTANCE_SENSOR, only="DISTANCE_SENSOR")
    assert ack.result == 2


def test_flight_information_tells_when_it_was_armed_and_took_off(flight: Any) -> None:
    one = flight("gcs", utc_boot_us=BOOT_UTC_US)
    one.run(2.5)
    grounded, _ = ask(one, 512, FLIGHT_INFORMATION, only="FLIGHT_INFORMATION")
    assert (grounded.arming_time_utc, grounded.takeoff_time_utc) == (0, 0)
    armed_us = one.vehicle.time_us
    assert one.vehicle.autopilot.command_arm(True) == 0
    assert one.vehicle.autopilot.command_takeoff(None) == 0
    one.run(6.0)
    flown, _ = ask(one, 512, FLIGHT_INFORMATION, only="FLIGHT_INFORMATION")
    assert flown.arming_time_utc - BOOT_UTC_US == pytest.approx(armed_us, abs=20_000)
    assert 1_000_000 < flown.takeoff_time_utc - flown.arming_time_utc < 4_000_000


def test_flight_information_at_a_rate(flight: Any) -> None:
    one = flight("gcs")
    one.run(0.1)
    (ack, *_) = ask(one, 511, FLIGHT_INFORMATION, 100_000, only="COMMAND_ACK")
    assert ack.result == 0
    before = one.ground.counts()["FLIGHT_INFORMATION"]
    one.run(1.0)
    assert 9 <= one.ground.counts()["FLIGHT_INFORMATION"] - before <= 11


def test_short_messages_say_the_same_as_the_long_ones(flight: Any) -> None:
    one = flight("gcs", utc_boot_us=BOOT_UTC_US)
    one.run(2.5)
    assert one.vehicle.autopilot.command_arm(True) == 0
    assert one.vehicle.autopilot.command_takeoff(None) == 0
    one.run(8.0)
    far, _ = ask(one, 512, UTM_GLOBAL_POSITION, only="UTM_GLOBAL_POSITION")
    place = next(m for m in ask(one, 512, 33, only="GLOBAL_POSITION_INT") if m.name == "GLOBAL_POSITION_INT")
    short, _ = ask(one, 512, HIGH_LATENCY2, only="HIGH_LATENCY2")
    assert far.flight_state == 3
    assert far.relative_alt == pytest.approx(place.relative_alt, abs=100)
    assert (far.lat, far.lon) == pytest.approx((place.lat, place.lon), abs=20)
    assert (short.latitude, short.longitude) == pytest.approx((place.lat, place.lon), abs=20)
    assert short.altitude == pytest.approx(place.alt / 1000.0, abs=1.0)
    assert short.custom_mode == 4 | 3 << 8
