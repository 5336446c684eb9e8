from __future__ import annotations

import dataclasses
import os
import signal
from pathlib import Path
from typing import Any

import pytest

from bridge.clock import ScaledClock
from bridge.errors import LinkUrlError, PortBusy
from bridge.fleet_status import FleetStatus as Status
from bridge.signing import Signer, SigningKey
from bridge.sitl_links import (
    banner,
    check_bind,
    check_instances,
    check_links,
    close_links,
    default_urls,
    exposure,
    link_urls,
    open_links,
)
from bridge.sitl_server import (
    SitlOptions,
    build_fleet,
    build_vehicle,
    check_files,
    expand_specs,
    refuses_unsigned,
    serve,
    stop_on_signals,
)
from bridge.udp_link import UdpLink
from sitl.errors import FileError, UsageError


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


def behind_after_a_pause(one: Any, pause_us: int, seconds: float, speed: float = 1.0) -> list[tuple[int, float]]:
    """(vehicle time, what it is behind the clock, us) of every tick after one that takes so long."""
    wall = FakeWall()
    stall_at = one.vehicle.tick + 100
    step = one.vehicle.step
    ticks: list[tuple[int, float]] = []

    def stalling_step() -> None:
        if one.vehicle.tick == stall_at:
            wall.time_us += pause_us  # the computer slept
        step()
        ticks.append((one.vehicle.time_us, wall.time_us * speed - one.vehicle.time_us))

    one.vehicle.step = stalling_step
    serve(one.vehicle, one.links, ScaledClock(speed, wall), stop=lambda: one.vehicle.tick > stall_at + 250 * seconds)
    before = ticks[50][1]
    return [(time_us, late_us - before) for time_us, late_us in ticks[105:]]


@pytest.mark.parametrize("speed", [1.0, 4.0])
def test_what_was_late_is_made_up_for_and_not_in_a_rush(flight: Any, speed: float) -> None:
    after = behind_after_a_pause(flight(heartbeats=False), 500_000, 60.0, speed)
    assert after[0][1] == pytest.approx(500_000 * speed, abs=20_000)
    for (t0, late0), (t1, late1) in zip(after, after[250:], strict=False):
        assert 0.94 < (t1 - t0 + late1 - late0) / (t1 - t0) < 1.01  # of the clock, for a second of flight
    assert after[-1][1] == pytest.approx(0.0, abs=4000 * speed)
    soonest = next(time_us for time_us, late_us in after if late_us < 5_000 * speed) - after[0][0]
    assert soonest == pytest.approx(10_000_000 * speed, rel=0.1)


def test_what_was_slept_is_not_made_up_for_without_end(flight: Any) -> None:
    """An hour: ten seconds of it are flown, the vehicle does not hurry on for a day."""
    after = behind_after_a_pause(flight(heartbeats=False), 3_600_000_000, 250.0)
    assert after[-1][1] == pytest.approx(3_590_000_000, abs=10_000)
    assert after[-1][1] == pytest.approx(after[-2500][1], abs=4000)


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


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
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


def test_a_hangup_stays_ignored_under_nohup() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stop_on_signals() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not stop()
            os.kill(os.getpid(), signal.SIGTERM)
            assert stop()
    finally:
        signal.signal(signal.SIGHUP, before)


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

    @pytest.mark.parametrize("instance", [-1, 255])
    def test_no_such_instance(self, instance: int) -> None:
        with pytest.raises(UsageError, match="--instance"):
            default_urls(instance)

    def test_a_busy_port_is_named_and_the_others_are_released(self) -> None:
        with UdpLink.listen("127.0.0.1", 0) as busy, UdpLink.listen("127.0.0.1", 0) as probe:
            free = probe.port
            probe.close()
            urls = [f"udpout://127.0.0.1:9?local={free}", f"udpout://127.0.0.1:9?local={busy.port}"]
            with pytest.raises(PortBusy, match=rf"^instance 3: 127\.0\.0\.1:{busy.port} is in use"):
                open_links(urls, instance=3)
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

    def test_a_wider_address(self) -> None:
        assert default_urls(1, "0.0.0.0") == (
            "udpout://127.0.0.1:14550?local=18571&bind=0.0.0.0#gcs",
            "udpout://127.0.0.1:14541?local=14581&bind=0.0.0.0#onboard",
        )
        assert check_bind("127.0.0.1") == "127.0.0.1"
        for wrong in ("::", "localhost", "", "192.168.1"):
            with pytest.raises(UsageError, match=r"--bind .*: give an IPv4 address"):
                check_bind(wrong)

    def test_addresses_of_the_users_own_grow_by_the_instance(self) -> None:
        given = ("udpout://127.0.0.1:14560+i?local=18570+i#gcs", "tcpin://127.0.0.1:5760+i", "udpout://gcs:14550")
        assert link_urls(4, given=given) == (
            "udpout://127.0.0.1:14564?local=18574#gcs",
            "tcpin://127.0.0.1:5764",
            "udpout://gcs:14550",
        )
        assert link_urls(2) == default_urls(2)

    @pytest.mark.parametrize(
        ("url", "shared"),
        [
            ("udpout://127.0.0.1:14550", True),
            ("tcpout://127.0.0.1:4560#onboard", True),
            ("udpin://127.0.0.1:14550+i", True),
            ("udpout://127.0.0.1:14550?local=18570+i", True),
            ("udpin://127.0.0.1:14550", False),
            ("udpout://127.0.0.1:14550?local=18570", False),
            ("tcpin://127.0.0.1:5760", False),
            ("serial:///dev/ttyUSB0:57600", False),
        ],
    )
    def test_what_several_vehicles_can_share(self, url: str, shared: bool) -> None:
        check_links([url], bind="127.0.0.1", count=1)
        if shared:
            check_links([url], bind="127.0.0.1", count=2)
        else:
            with pytest.raises(LinkUrlError, match=r"2 vehicles cannot share it. Write \+i"):
                check_links([url], bind="127.0.0.1", count=2)

    def test_bind_is_about_the_default_ports(self) -> None:
        check_links([], bind="0.0.0.0", count=3)
        with pytest.raises(UsageError, match="--link replaces those"):
            check_links(["udpin://127.0.0.1:1"], bind="0.0.0.0", count=1)

    @pytest.mark.parametrize(("first", "count"), [(0, 255), (254, 1), (100, 155)])
    def test_enough_systems(self, first: int, count: int) -> None:
        check_instances(first, count)
        with pytest.raises(UsageError, match="MAVLink's last one is 255"):
            check_instances(first, count + 1)

    def test_what_others_can_reach_is_named(self) -> None:
        urls = [*default_urls(200, "0.0.0.0"), *default_urls(201, "0.0.0.0"), *default_urls(202)]
        links = open_links(urls, instance=200)
        try:
            warning = exposure(links, guarded=False)
            assert warning is not None
            assert "every address of this computer, port 14780-14781, 18770-18771." in warning
            assert "arm, fly and change every parameter" in warning
            assert "--signing-key" in warning
            assert "only signed messages are obeyed" in (exposure(links, guarded=True) or "")
            assert exposure(links[4:], guarded=False) is None
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


class TestSpecs:
    def test_a_count_repeats(self) -> None:
        assert expand_specs(["ant-x", "ant-r:adam-0*2", "ant-x*3"]) == ["ant-x", *2 * ["ant-r:adam-0"], *3 * ["ant-x"]]

    def test_a_file_of_that_name_comes_first(self, tmp_path: Path) -> None:
        odd = tmp_path / "mine*2"
        odd.touch()
        assert expand_specs([str(odd)]) == [str(odd)]

    @pytest.mark.parametrize("words", [["ant-x*0"], ["ant-x*256"], ["ant-x*200", "ant-r*56"]])
    def test_too_few_or_many(self, words: list[str]) -> None:
        with pytest.raises(UsageError, match="vehicles"):
            expand_specs(words)


class TestOptions:
    def test_one_vehicle_uses_what_was_given(self) -> None:
        options = SitlOptions(seed=7, state=Path("a/mine.params"), log_dir=Path("logs"), signing_key=Path("key"))
        own = options.of_instance(3)
        assert (own.seed, own.state, own.log_dir, own.signing_key) == (
            7,
            Path("a/mine.params"),
            Path("logs"),
            Path("key"),
        )
        assert own.links == default_urls(3)

    def test_several_vehicles_have_noise_and_files_of_their_own_and_one_key(self) -> None:
        options = SitlOptions(seed=7, state=Path("a/m.params"), log_dir=Path("logs"), signing_key=Path("key"))
        own = [dataclasses.replace(options, several=True).of_instance(instance) for instance in (0, 2)]
        assert [one.seed for one in own] == [7, 9]
        assert [one.state for one in own] == [Path("a/m.0.params"), Path("a/m.2.params")]
        assert [one.log_dir for one in own] == [Path("logs/0"), Path("logs/2")]
        assert {one.signing_key for one in own} == {Path("key")}

    def test_files_that_cannot_be_used_are_named(self, tmp_path: Path) -> None:
        key = tmp_path / "key"
        key.touch(0o600)
        key.write_bytes(bytes(range(32)))
        shared = tmp_path / "shared"
        shared.write_bytes(bytes(range(32)))
        shared.chmod(0o644)
        check_files(SitlOptions(state=tmp_path / "s", log_dir=tmp_path / "new", signing_key=key))
        for options, says in (
            (SitlOptions(state=tmp_path), "is a folder. Give --state a file"),
            (SitlOptions(state=tmp_path / "no" / "s"), "its folder does not exist"),
            (SitlOptions(log_dir=key), "is not a folder"),
            (SitlOptions(log_dir=tmp_path / "no" / "logs"), "its parent folder does not exist"),
            (SitlOptions(signing_key=tmp_path / "no"), "no such key file"),
            (SitlOptions(signing_key=shared), "shared"),
        ):
            with pytest.raises(FileError, match=says):
                check_files(options)


class TestBuild:
    LINKS = ("udpin://127.0.0.1:0", "udpin://127.0.0.1:0#onboard")

    def test_a_vehicle(self) -> None:
        server = build_vehicle("ant-r", 4, SitlOptions(profile="study", links=self.LINKS))
        try:
            assert server.vehicle.model.name == "ANT-R"
            assert server.vehicle.profile.name == "study"
            assert server.sysid == server.vehicle.parameters.get("MAV_SYS_ID") == 5
            assert [link.mode for link in server.links] == ["gcs", "onboard"]
            assert server.source.utc_boot_us > 1_600_000_000_000_000
        finally:
            close_links(server.links)

    def test_only_a_key_and_a_parameter_together_refuse_what_is_unsigned(self) -> None:
        server = build_vehicle("ant-x", 0, SitlOptions(links=self.LINKS))
        try:
            assert not refuses_unsigned(server)
            server.vehicle.parameters.set("MAV_SIGN_CFG", 2)
            assert not refuses_unsigned(server)
            for link in server.links:
                link.connection.signer = Signer(SigningKey(bytes(range(32))), link.link_id)
            assert refuses_unsigned(server)
            server.vehicle.parameters.set("MAV_SIGN_CFG", 0)
            assert not refuses_unsigned(server)
        finally:
            close_links(server.links)

    def test_a_fleet(self) -> None:
        servers = build_fleet(["ant-x", "ant-r"], 7, SitlOptions(links=self.LINKS, several=True))
        try:
            assert [server.sysid for server in servers] == [8, 9]
            assert [server.vehicle.seed for server in servers] == [7, 8]
        finally:
            for server in servers:
                close_links(server.links)

    def test_a_fleet_is_whole_or_none(self) -> None:
        with UdpLink.listen("127.0.0.1", 0) as busy:
            free = busy.port - 1 if busy.port > 40_000 else busy.port + 1
            options = SitlOptions(links=(f"udpin://127.0.0.1:{min(free, busy.port)}+i",), several=True)
            with pytest.raises(PortBusy, match=rf"instance [01]: 127.0.0.1:{busy.port} "):
                build_fleet(["ant-x", "ant-x"], 0, options)
            UdpLink.listen("127.0.0.1", free).close()


@pytest.mark.parametrize(
    ("speed", "flush_us"), [(0.5, 80_000), (1.0, 80_000), (4.0, 320_000), (50.0, 1_000_000), (None, 1_000_000)]
)
def test_a_log_is_written_every_tenth_of_a_second_of_the_clock(
    speed: float | None, flush_us: int, tmp_path: Path
) -> None:
    options = SitlOptions(links=("udpout://127.0.0.1:19",), log_dir=tmp_path, speed=speed)
    server = build_vehicle("ant-x", 0, options)
    try:
        assert server.services.log is not None
        server.services.log.tick()
        assert server.services.log._flush_every_us == flush_us
    finally:
        server.close()
        close_links(server.links)
