from __future__ import annotations

import os
import signal
from typing import Any

import pytest

from bridge.clock import ScaledClock
from bridge.errors import LinkUrlError, PortBusy
from bridge.sitl_server import (
    Status,
    banner,
    close_links,
    default_urls,
    open_links,
    serve,
    stop_on_signals,
)
from bridge.udp_link import UdpLink
from sitl.errors import UsageError


class FakeWall:
    """A wall clock that passes only while somebody sleeps, and a little with every tick of the vehicle."""

    def __init__(self, tick_cost_us: int = 0) -> None:
        self.time_us = 1_000_000
        self.tick_cost_us = tick_cost_us
        self.slept = 0

    def now_us(self) -> int:
        return self.time_us

    def sleep_until_us(self, time_us: int) -> int:
        self.slept += 1
        self.time_us = max(self.time_us, time_us)
        return self.time_us - time_us


def fly(flight: Any, speed: float | None, wall: FakeWall, seconds: float) -> list[Status]:
    """Serve a vehicle for some wall time; return what was reported."""
    one = flight(heartbeats=False)
    reports: list[Status] = []
    end_us = wall.time_us + seconds * 1e6
    step = one.vehicle.step

    def costly_step() -> None:
        wall.time_us += wall.tick_cost_us
        step()

    one.vehicle.step = costly_step
    clock = None if speed is None else ScaledClock(speed, wall)
    serve(one.vehicle, one.links, clock, stop=lambda: wall.time_us >= end_us, report=reports.append, wall=wall)
    return reports


@pytest.mark.parametrize("speed", [0.5, 1.0, 8.0, 40.0])
def test_flies_at_the_speed_asked_for(flight: Any, speed: float) -> None:
    for status in fly(flight, speed, FakeWall(), 5.0):
        assert status.speed == pytest.approx(speed, rel=0.02)
        assert "too slow" not in status.line()


def test_a_slow_machine_flies_slower_and_says_so(flight: Any) -> None:
    wall = FakeWall(tick_cost_us=10_000)  # 10 ms of work for 4 ms of flight
    reports = fly(flight, 1.0, wall, 6.0)
    assert len(reports) >= 5
    for status in reports:
        assert status.speed == pytest.approx(0.4, rel=0.05)
        assert "too slow for 1 x" in status.line()


def test_what_was_late_is_not_made_up_for(flight: Any) -> None:
    one = flight(heartbeats=False)
    wall = FakeWall()
    stall_at = one.vehicle.tick + 100
    step = one.vehicle.step
    ticks: list[tuple[int, int]] = []

    def stalling_step() -> None:
        if one.vehicle.tick == stall_at:
            wall.time_us += 10_000_000  # the computer slept
        step()
        ticks.append((wall.time_us, one.vehicle.time_us))

    one.vehicle.step = stalling_step
    serve(one.vehicle, one.links, ScaledClock(1.0, wall), stop=lambda: one.vehicle.tick > stall_at + 500)
    after = [vehicle_us - wall_us for wall_us, vehicle_us in ticks[stall_at + 50 :]]
    # Soon after the stall vehicle time runs beside wall time again: 10 s are lost, not flown in a rush.
    assert max(after) - min(after) <= 4000


def test_as_fast_as_possible_never_sleeps(flight: Any) -> None:
    wall = FakeWall(tick_cost_us=20)
    (status, *_) = fly(flight, None, wall, 2.0)
    assert wall.slept == 0
    assert status.speed == pytest.approx(4000 / 20, rel=0.05)


def test_listens_between_two_ticks(flight: Any) -> None:
    one = flight(heartbeats=False)
    wall = FakeWall()
    asked: list[int] = []
    sleep = wall.sleep_until_us

    def ask_while_it_sleeps(time_us: int) -> int:
        if one.vehicle.tick == 10 and not asked:
            one.ground.send(
                "PARAM_REQUEST_READ",
                target_system=1,
                target_component=1,
                param_id="MC_ROLL_P",
                param_index=-1,
            )
            asked.append(wall.time_us)
        late_us = sleep(time_us)
        if one.vehicle.tick == 10:
            one.ground.listen(wall.time_us)
        return late_us

    wall.sleep_until_us = ask_while_it_sleeps  # type: ignore[method-assign]
    serve(one.vehicle, one.links, ScaledClock(0.1, wall), stop=lambda: one.vehicle.tick > 11)
    answered = [now_us for now_us, message in one.ground.heard if message.name == "PARAM_VALUE"]
    assert answered[0] - asked[0] <= 2_000


def test_ends_when_a_ground_station_switches_it_off(flight: Any) -> None:
    one = flight(heartbeats=False)
    one.ground.send("COMMAND_LONG", target_system=1, target_component=1, command=246, param1=2.0)
    server = serve(one.vehicle, one.links, None, stop=lambda: one.vehicle.tick > 5)
    assert server.shutdown_asked
    assert one.vehicle.tick <= 2


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ends_on_signals_and_puts_the_old_handlers_back(flight: Any, number: signal.Signals) -> None:
    before = signal.getsignal(number)
    one = flight(heartbeats=False)
    step = one.vehicle.step

    def interrupted_step() -> None:
        if one.vehicle.tick == 5:
            os.kill(os.getpid(), number)
        step()

    one.vehicle.step = interrupted_step
    with stop_on_signals() as stop:
        serve(one.vehicle, one.links, None, stop=stop)
    assert one.vehicle.tick < 10
    assert signal.getsignal(number) is before


class TestPorts:
    def test_are_those_of_a_px4(self) -> None:
        assert default_urls(0) == (
            "udpout://127.0.0.1:14550?local=18570#gcs",
            "udpout://127.0.0.1:14540?local=14580#onboard",
        )
        assert default_urls(3) == (
            "udpout://127.0.0.1:14550?local=18573#gcs",
            "udpout://127.0.0.1:14543?local=14583#onboard",
        )
        assert default_urls(12)[1] == "udpout://127.0.0.1:14549?local=14592#onboard"

    @pytest.mark.parametrize("instance", [-1, 250])
    def test_no_such_instance(self, instance: int) -> None:
        with pytest.raises(UsageError, match="--instance"):
            default_urls(instance)

    def test_a_busy_port_is_named_and_the_others_are_released(self) -> None:
        with UdpLink.listen("127.0.0.1", 0) as busy, UdpLink.listen("127.0.0.1", 0) as probe:
            free = probe.port
            probe.close()
            urls = [f"udpout://127.0.0.1:9?local={free}", f"udpout://127.0.0.1:9?local={busy.port}"]
            with pytest.raises(PortBusy, match=str(busy.port)):
                open_links(urls)
            UdpLink.listen("127.0.0.1", free).close()

    def test_links_carry_the_instance_and_their_rates(self) -> None:
        links = open_links(["udpin://127.0.0.1:0", "udpin://127.0.0.1:0#onboard"], instance=4)
        try:
            assert [link.mode for link in links] == ["gcs", "onboard"]
            assert {link.connection.sysid for link in links} == {5}
            assert [link.link_id for link in links] == [0, 1]
            line = banner("ant-x", links)
            assert line.startswith("ant-x is system 5, serving ground station at udpin://127.0.0.1:")
            assert "MAVSDK" in line
        finally:
            close_links(links)

    def test_unknown_rates(self) -> None:
        with pytest.raises(LinkUrlError, match="#gcs"):
            open_links(["udpin://127.0.0.1:0#fast"])


def test_the_parameter_tells_the_system(flight: Any) -> None:
    one = flight(heartbeats=False)
    one.links[0].connection.sysid = 7
    serve(one.vehicle, one.links, None, stop=lambda: True)
    assert one.vehicle.parameters.get("MAV_SYS_ID") == 7
