"""What passes between a board and ground stations, and what does not."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.connection import Connection, Message
from bridge.ground_router import BURST_BYTES, BYTES_PER_S, GroundRouter, arms
from bridge.link import MemoryLink


class Rig:
    """A router with two ground stations and a board's voice."""

    def __init__(self, *, may_arm: bool = False) -> None:
        self.said: list[str] = []
        pairs = [MemoryLink.pair() for _ in range(2)]
        self.grounds = [far for _, far in pairs]
        self.router = GroundRouter([near for near, _ in pairs], may_arm=may_arm, say=self.said.append)
        self.board = Connection(1, 1)
        self.voice = Connection(255, 190)

    def message(self, name: str, **fields: object) -> Message:
        return Connection(9, 9).receive(self.board.encode(name, **fields))[0]

    def heard(self, ground: int) -> list[Message]:
        reader, messages = Connection(9, 9, datagram=True), []
        while (data := self.grounds[ground].recv()) is not None:
            messages += reader.receive(data)
        return messages

    def asks(self, ground: int, name: str, **fields: object) -> bytes:
        frame = self.voice.encode(name, **fields)
        self.grounds[ground].send(frame)
        return frame


ARM = {"target_system": 1, "target_component": 1, "command": 400, "param1": 1.0}


def test_every_ground_station_hears_the_board_byte_for_byte_but_not_the_motors() -> None:
    rig = Rig()
    attitude = rig.message("ATTITUDE", time_boot_ms=7, roll=0.25)
    rig.router.from_board(attitude)
    rig.router.from_board(rig.message("HIL_ACTUATOR_CONTROLS", time_usec=1))
    for ground in range(2):
        heard = rig.heard(ground)
        assert [one.raw_frame for one in heard] == [attitude.raw_frame]


def test_what_a_ground_station_asks_reaches_the_board_unchanged() -> None:
    rig = Rig()
    first = rig.asks(0, "PARAM_REQUEST_LIST", target_system=1, target_component=1)
    second = rig.asks(1, "COMMAND_LONG", target_system=1, target_component=1, command=512, param1=148.0)
    assert rig.router.from_grounds(0) == [first, second]
    assert rig.router.from_grounds(1) == []


def test_a_ground_station_that_never_stops_talking_does_not_hold_the_plant() -> None:
    rig = Rig()
    rig.router.grounds[0].recv = lambda timeout_s=0.0: bytes(40)  # type: ignore[method-assign]
    frame = rig.asks(1, "PARAM_REQUEST_LIST", target_system=1, target_component=1)
    assert rig.router.from_grounds(0) == [frame]


@pytest.mark.parametrize("name", ["HIL_SENSOR", "HIL_GPS", "HIL_STATE_QUATERNION", "HIL_ACTUATOR_CONTROLS"])
def test_nobody_else_feeds_the_board_sensors(name: str) -> None:
    rig = Rig(may_arm=True)
    rig.asks(0, name, time_usec=5)
    assert rig.router.from_grounds(0) == []


def test_arming_is_refused_in_the_boards_name_unless_allowed() -> None:
    rig = Rig()
    rig.asks(0, "COMMAND_LONG", **ARM)
    assert rig.router.from_grounds(0) == []
    ack, text = rig.heard(0)
    assert (ack.name, ack.command, ack.result, ack.sysid, ack.compid) == ("COMMAND_ACK", 400, 2, 1, 1)
    assert "--arm-hardware" in text.text
    assert rig.heard(1) == []
    assert rig.router.refused_arming == 1
    assert len(rig.said) == 1
    assert "--arm-hardware" in rig.said[0]

    allowed = Rig(may_arm=True)
    frame = allowed.asks(0, "COMMAND_LONG", **ARM)
    assert allowed.router.from_grounds(0) == [frame]


def test_sticks_may_arm_by_gesture_and_a_shell_by_a_word_so_they_need_the_same_leave() -> None:
    for may_arm in (False, True):
        for name, fields in (
            ("MANUAL_CONTROL", {"target": 1, "z": 0, "r": 1000}),
            ("RC_CHANNELS_OVERRIDE", {"target_system": 1, "chan3_raw": 1000, "chan4_raw": 2000}),
            ("SERIAL_CONTROL", {"device": 10, "flags": 6, "count": 14, "data": b"commander arm\n"}),
        ):
            rig = Rig(may_arm=may_arm)
            rig.asks(0, name, **fields)
            assert bool(rig.router.from_grounds(0)) is may_arm, name


@pytest.mark.parametrize(
    ("name", "fields", "arming"),
    [
        ("COMMAND_LONG", {"command": 400, "param1": 1.0}, True),
        ("COMMAND_LONG", {"command": 400, "param1": float("nan")}, True),
        ("COMMAND_LONG", {"command": 400, "param1": 0.0, "param2": 21196.0}, False),
        ("COMMAND_INT", {"command": 400, "param1": 1.0}, True),
        ("COMMAND_LONG", {"command": 176, "param1": 129.0, "param2": 6.0}, True),
        ("COMMAND_LONG", {"command": 176, "param1": 1.0, "param2": 6.0}, False),
        ("COMMAND_LONG", {"command": 176, "param1": float("inf")}, False),
        ("SET_MODE", {"target_system": 1, "base_mode": 129, "custom_mode": 0}, True),
        ("SET_MODE", {"target_system": 1, "base_mode": 1, "custom_mode": 0}, False),
        ("PARAM_SET", {"param_id": "MC_ROLL_P"}, False),
        *(("COMMAND_LONG", {"command": number}, True) for number in (300, 209, 310, 183, 184, 187)),
        *(("COMMAND_INT", {"command": number}, True) for number in (300, 209, 310, 183, 184, 187)),
        ("COMMAND_LONG", {"command": 241, "param7": 1.0}, True),
        ("COMMAND_INT", {"command": 241, "z": 1.0}, True),
        ("COMMAND_LONG", {"command": 241, "param1": 1.0}, False),
        ("COMMAND_LONG", {"command": 22, "param7": 10.0}, False),
    ],
)
def test_what_arms(name: str, fields: dict[str, object], arming: bool) -> None:
    assert arms(Rig().message(name, **fields)) is arming


def test_a_ground_station_cannot_fill_the_line_that_the_sensors_need() -> None:
    rig = Rig()
    sent = 0
    for _ in range(1000):
        sent += len(rig.asks(0, "PARAM_REQUEST_READ", target_system=1, target_component=1, param_id="MC_ROLL_P"))
    passed = sum(len(frame) for _ in range(1000) for frame in rig.router.from_grounds(0))
    assert passed <= BURST_BYTES
    assert passed + rig.router.dropped_bytes == sent

    for _ in range(1000):
        rig.asks(0, "PARAM_REQUEST_READ", target_system=1, target_component=1, param_id="MC_ROLL_P")
    later = sum(len(frame) for _ in range(1000) for frame in rig.router.from_grounds(100_000))
    assert later <= 0.1 * BYTES_PER_S + (BURST_BYTES - passed)
    assert later >= 0.1 * BYTES_PER_S - 64


@given(st.binary(max_size=400))
def test_bytes_that_are_no_frames_reach_nobody(junk: bytes) -> None:
    rig = Rig(may_arm=True)
    rig.grounds[0].send(junk)
    frame = rig.asks(0, "PARAM_REQUEST_LIST", target_system=1, target_component=1)
    # junk may begin like a frame of its own datagram; the next datagram stands alone
    assert rig.router.from_grounds(0)[-1:] == [frame]


def test_a_ground_station_that_went_away_does_not_stop_the_plant() -> None:
    rig = Rig()
    rig.grounds[0].close()
    rig.router.from_board(rig.message("ATTITUDE", time_boot_ms=7))
    assert rig.router.from_grounds(0) == []
    assert [one.name for one in rig.heard(1)] == ["ATTITUDE"]
