"""The vehicle's side of the parameter protocol, against what a real PX4 answered."""

from __future__ import annotations

import itertools
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.connection import Connection, Message
from bridge.param_protocol import Outgoing, ParamServer, float_in_disguise
from sitl.parameters import ParameterSpec, ParameterTable

GROUND, API = 0, 1
TICK_US = 4_000
INT32, REAL32 = 6, 9
FOUR_BYTES = st.binary(min_size=4, max_size=4)


class Ground:
    """A ground station 255/190 that keeps every answer with its time, over real frames."""

    def __init__(self, table: ParameterTable | None = None, **own: int) -> None:
        self.table = table or ParameterTable()
        self.server = ParamServer(self.table, **own)
        self.now_us = 1_000_000
        self.heard: dict[int, list[tuple[int, Message]]] = {GROUND: [], API: []}
        self._up = Connection(255, 190)
        self._up_rx = Connection(1, 1)
        self._down = Connection(1, 1)
        self._down_rx = Connection(255, 190)
        self.server.poll(GROUND, self.now_us)
        self.server.poll(API, self.now_us)

    def send(self, name: str, link: int = GROUND, **fields: Any) -> None:
        target = {"target_system": 1, "target_component": 1}
        for message in self._up_rx.receive(self._up.encode(name, **{**target, **fields})):
            self._keep(link, self.server.handle(message, link, self.now_us))

    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds * 1e6 / TICK_US)):
            for link in (GROUND, API):
                self._keep(link, self.server.poll(link, self.now_us))
            self.now_us += TICK_US

    def ask(self, name: str, seconds: float = 0.6, link: int = GROUND, **fields: Any) -> list[Message]:
        start = len(self.heard[link])
        self.send(name, link, **fields)
        self.wait(seconds)
        return [message for _, message in self.heard[link][start:]]

    def _keep(self, link: int, out: list[Outgoing]) -> None:
        for name, fields in out:
            for message in self._down_rx.receive(self._down.encode(name, **fields)):
                self.heard[link].append((self.now_us, message))


def real(value: float) -> bytes:
    return struct.pack("<f", value)


def whole(value: int) -> bytes:
    return struct.pack("<i", value)


def told(message: Message) -> tuple[Any, ...]:
    """A message as a tuple that compares."""
    if message.name == "PARAM_ERROR":
        fields = message.fields()
        return tuple(fields[key] for key in ("target_system", "target_component", "param_id", "error"))
    return (message.param_id, message.raw("param_value"), message.param_type)


def error(name: str, code: int) -> tuple[Any, ...]:
    return (255, 190, name, code)


# Recorded from a PX4 SITL (May 2026): PARAM_REQUEST_READ fields -> answers
READS: list[tuple[str, dict[str, Any], list[tuple[Any, ...]]]] = [
    ("float", {"param_id": "MC_ROLLRATE_P", "param_index": -1}, [("MC_ROLLRATE_P", real(0.15), REAL32)]),
    ("int, bytewise", {"param_id": "MC_AIRMODE", "param_index": -1}, [("MC_AIRMODE", whole(0), INT32)]),
    (
        "16 characters",
        {"param_id": "COM_DISARM_PRFLT", "param_index": -1},
        [("COM_DISARM_PRFLT", real(10.0), REAL32)],
    ),
    ("index too big", {"param_id": "", "param_index": 30000}, [error("", 1)]),
    ("empty name", {"param_id": "", "param_index": -1}, [error("", 1)]),
    ("lower case", {"param_id": "mc_rollrate_p", "param_index": -1}, [error("mc_rollrate_p", 1)]),
    ("prefix", {"param_id": "MC_ROLLRATE", "param_index": -1}, [error("MC_ROLLRATE", 1)]),
    ("index -2 is by name", {"param_id": "MC_ROLL_P", "param_index": -2}, [("MC_ROLL_P", real(4.0), REAL32)]),
    (
        "component 0",
        {"target_component": 0, "param_id": "MC_ROLLRATE_P", "param_index": -1},
        [("MC_ROLLRATE_P", real(0.15), REAL32)],
    ),
    ("both 0", {"target_system": 0, "target_component": 0, "param_id": "MC_ROLL_P", "param_index": -1}, []),
    ("component 77", {"target_component": 77, "param_id": "MC_ROLL_P", "param_index": -1}, []),
    ("system 9", {"target_system": 9, "param_id": "MC_ROLL_P", "param_index": -1}, []),
]


@pytest.mark.parametrize(("fields", "answers"), [case[1:] for case in READS], ids=[case[0] for case in READS])
def test_read_as_px4(fields: dict[str, Any], answers: list[tuple[Any, ...]]) -> None:
    ground = Ground()
    assert [told(message) for message in ground.ask("PARAM_REQUEST_READ", **fields)] == answers


def test_read_by_index_ignores_the_name() -> None:
    ground = Ground()
    (answer,) = ground.ask("PARAM_REQUEST_READ", param_id="MC_ROLLRATE_P", param_index=7)
    assert answer.param_id == ground.table.names[7]
    assert (answer.param_index, answer.param_count) == (7, len(ground.table))


def test_unknown_index_is_named_in_the_error() -> None:
    (answer,) = Ground().ask("PARAM_REQUEST_READ", param_index=30000)
    assert (answer.name, answer.param_index, answer.error) == ("PARAM_ERROR", 30000, 1)


def test_hash_can_be_read_by_name() -> None:
    ground = Ground()
    (answer,) = ground.ask("PARAM_REQUEST_READ", param_id="_HASH_CHECK", param_index=-1)
    assert told(answer) == ("_HASH_CHECK", struct.pack("<I", ground.table.hash_check()), 5)
    assert (answer.param_index, answer.param_count) == (65535, len(ground.table))


# Recorded: name, value, type -> PARAM_ERROR code, or how often PARAM_VALUE comes within 0.6 s (a changed
# value is announced once more, an unchanged one is not)
INFINITE, NOT_A_NUMBER = float("inf"), float("nan")
SETS: list[tuple[str, bytes, int, int | None, int]] = [
    ("MC_ROLLRATE_P", real(0.17), REAL32, None, 2),
    ("MC_PITCHRATE_P", real(0.15), REAL32, None, 1),
    ("MC_AIRMODE", whole(0), INT32, None, 1),
    ("MC_AIRMODE", whole(-1), INT32, None, 2),
    ("MC_AIRMODE", whole(99), INT32, None, 2),
    ("MC_PITCHRATE_MAX", real(INFINITE), REAL32, None, 2),
    ("MC_PITCHRATE_MAX", real(NOT_A_NUMBER), REAL32, None, 2),
    ("MC_ROLLRATE_P", real(99.0), REAL32, None, 2),
    ("MC_AIRMODE", real(1.0), REAL32, 7, 1),
    ("MC_ROLL_P", whole(5), INT32, 7, 1),
    ("MC_AIRMODE", whole(1), 1, 6, 1),
    ("MC_AIRMODE", whole(1), 2, 6, 1),
    ("MC_AIRMODE", whole(1), 10, 6, 1),
    ("MC_AIRMODE", whole(1), 77, 6, 1),
    ("NO_SUCH_PARAM", real(1.0), REAL32, 1, 1),
    ("NO_SUCH_PARAM", real(1.0), 77, 1, 1),
    ("", real(1.0), REAL32, 1, 1),
    ("_HASH_CHECK", whole(1), 5, 5, 1),
]


@pytest.mark.parametrize(("name", "raw", "kind", "code", "times"), SETS)
def test_set_as_px4(name: str, raw: bytes, kind: int, code: int | None, times: int) -> None:
    ground = Ground()
    before = ground.table.hash_check()
    answers = ground.ask("PARAM_SET", param_id=name, param_value=raw, param_type=kind)
    expected = (name, raw, kind) if code is None else error(name, code)
    assert [told(message) for message in answers] == [expected] * times
    assert (ground.table.hash_check() != before) == (times == 2)


def test_set_for_component_0_is_obeyed_and_for_system_0_is_not() -> None:
    ground = Ground()
    value = {"param_id": "MC_YAW_P", "param_value": 2.7, "param_type": REAL32}
    assert ground.ask("PARAM_SET", target_system=0, **value) == []
    assert ground.table.changed() == ()
    assert len(ground.ask("PARAM_SET", target_component=0, **value)) == 2
    assert ground.table.changed() == ("MC_YAW_P",)


def test_a_change_is_announced_again_after_a_while_on_every_link() -> None:
    ground = Ground()
    ground.send("PARAM_SET", API, param_id="MC_ROLLRATE_I", param_value=0.21, param_type=REAL32)
    start = ground.now_us
    ground.wait(2.0)
    times = {link: [(time - start) / 1e6 for time, _ in heard] for link, heard in ground.heard.items()}
    assert len(times[API]) == 2
    assert times[API][0] == 0.0
    assert 0.005 <= times[API][1] <= 0.5
    assert times[GROUND] == [times[API][1]]
    assert told(ground.heard[GROUND][0][1]) == ("MC_ROLLRATE_I", real(0.21), REAL32)


def test_a_change_from_inside_the_vehicle_is_announced_too() -> None:
    ground = Ground()
    ground.table.set("MC_ROLL_P", 5.0)
    ground.wait(0.5)
    assert [told(message) for _, message in ground.heard[GROUND]] == [("MC_ROLL_P", real(5.0), REAL32)]
    assert len(ground.heard[API]) == 1


def test_two_names_and_a_read_back_in_one_instant() -> None:
    ground = Ground()
    ground.send("PARAM_SET", param_id="MC_ROLLRATE_D", param_value=0.004, param_type=REAL32)
    ground.send("PARAM_SET", param_id="MC_PITCHRATE_D", param_value=0.005, param_type=REAL32)
    ground.send("PARAM_REQUEST_READ", param_id="MC_ROLLRATE_D", param_index=-1)
    ground.wait(0.6)
    heard = [told(message) for _, message in ground.heard[GROUND]]
    roll, pitch = ("MC_ROLLRATE_D", real(0.004), REAL32), ("MC_PITCHRATE_D", real(0.005), REAL32)
    assert heard == [roll, pitch, roll, pitch, roll]


def listing(messages: list[Message]) -> tuple[list[str], list[int]]:
    return [message.param_id for message in messages], [message.param_index for message in messages]


@pytest.mark.parametrize("component", [0, 1])
def test_list_is_the_hash_and_then_everything_in_order(component: int) -> None:
    ground = Ground()
    names, indices = listing(ground.ask("PARAM_REQUEST_LIST", 2.0, target_component=component))
    assert names == ["_HASH_CHECK", *ground.table.names]
    assert indices == [65535, *range(len(ground.table))]
    assert not ground.heard[API]


@pytest.mark.parametrize("target", [{"target_system": 0}, {"target_system": 9}, {"target_component": 77}])
def test_list_for_somebody_else_is_silence(target: dict[str, int]) -> None:
    assert Ground().ask("PARAM_REQUEST_LIST", 2.0, **target) == []


@pytest.mark.parametrize("burst", [3, 20])
def test_list_is_paced(burst: int) -> None:
    ground = Ground()
    ground.server.add_link(GROUND, burst=burst)
    ground.ask("PARAM_REQUEST_LIST", 3.0)
    groups = [(time, len(list(group))) for time, group in itertools.groupby(ground.heard[GROUND], lambda x: x[0])]
    assert all(size == burst for _, size in groups[:-1])
    gaps = [later[0] - earlier[0] for earlier, later in itertools.pairwise(groups)]
    assert min(gaps) >= 4_000
    assert sum(gaps) / len(gaps) == pytest.approx(4_000, rel=0.1)


def test_a_second_request_inside_starts_over_without_the_hash() -> None:
    ground = Ground()
    ground.send("PARAM_REQUEST_LIST")
    ground.wait(0.03)
    begun = len(ground.heard[GROUND])
    again = ground.ask("PARAM_REQUEST_LIST", 2.0)
    assert 1 < begun < len(ground.table)
    assert listing(again)[0] == list(ground.table.names)
    assert listing(ground.ask("PARAM_REQUEST_LIST", 2.0))[0][0] == "_HASH_CHECK"


def test_a_set_of_the_hash_stops_the_list_unless_that_is_switched_off() -> None:
    for switch, whole_list in ((1, False), (0, True)):
        ground = Ground(ParameterTable({"MAV_HASH_CHK_EN": switch}))
        ground.send("PARAM_REQUEST_LIST")
        ground.wait(0.02)
        answers = ground.ask("PARAM_SET", 2.0, param_id="_HASH_CHECK", param_type=5)
        assert told(answers[0]) == error("_HASH_CHECK", 5)
        assert (len(ground.heard[GROUND]) == len(ground.table) + 2) == whole_list
        assert listing(ground.ask("PARAM_REQUEST_LIST", 2.0))[0][0] == "_HASH_CHECK"


def test_a_set_while_the_list_is_sent_is_not_announced_twice() -> None:
    ground = Ground()
    ground.send("PARAM_REQUEST_LIST")
    ground.wait(0.02)
    ground.send("PARAM_SET", param_id="THR_MDL_FAC", param_value=0.3, param_type=REAL32)  # still to come
    ground.send("PARAM_SET", param_id="BAT1_N_CELLS", param_value=whole(3), param_type=INT32)  # was sent
    ground.wait(2.0)
    names = [message.param_id for _, message in ground.heard[GROUND]]
    assert names.count("THR_MDL_FAC") == 2  # echo and list
    assert names.count("BAT1_N_CELLS") == 3  # list, echo and announcement
    assert len(names) == len(ground.table) + 1 + 3
    last = {message.param_id: message.raw("param_value") for _, message in ground.heard[GROUND]}
    assert last["THR_MDL_FAC"] == real(0.3)


def test_extended_protocol_is_not_served() -> None:
    assert Ground().ask("PARAM_EXT_REQUEST_LIST") == []


def test_own_system_and_component_are_the_servers() -> None:
    ground = Ground(system_id=7, component_id=1)
    assert ground.ask("PARAM_REQUEST_READ", param_id="MC_ROLL_P", param_index=-1) == []
    assert len(ground.ask("PARAM_REQUEST_READ", target_system=7, param_id="MC_ROLL_P", param_index=-1)) == 1


@given(FOUR_BYTES)
def test_every_int32_pattern_survives_set_and_echo(raw: bytes) -> None:
    ground = Ground()
    ground.send("PARAM_SET", param_id="FD_FAIL_R", param_value=raw, param_type=INT32)
    assert told(ground.heard[GROUND][0][1]) == ("FD_FAIL_R", raw, INT32)
    assert ground.table.get("FD_FAIL_R") == struct.unpack("<i", raw)[0]


@given(FOUR_BYTES)
def test_every_float_pattern_survives_set_and_echo(raw: bytes) -> None:
    ground = Ground()
    ground.send("PARAM_SET", param_id="MC_ROLL_P", param_value=raw, param_type=REAL32)
    assert told(ground.heard[GROUND][0][1]) == ("MC_ROLL_P", raw, REAL32)
    assert ground.table.raw("MC_ROLL_P") == raw


@given(st.binary(min_size=16, max_size=16), FOUR_BYTES, st.integers(0, 255))
def test_any_name_and_type_gets_one_answer(name: bytes, raw: bytes, kind: int) -> None:
    ground = Ground()
    ground.send("PARAM_SET", param_id=name, param_value=raw, param_type=kind)
    ground.send("PARAM_REQUEST_READ", param_id=name, param_index=-1)
    answers = [message for _, message in ground.heard[GROUND]]
    assert [message.name for message in answers] == ["PARAM_ERROR", "PARAM_ERROR"]
    assert all(message.raw("param_id") == name for message in answers)
    assert ground.server.refused == 2


@pytest.mark.parametrize(
    ("name", "raw", "meant"),
    [
        ("MC_AIRMODE", real(1.0), 1.0),  # 1065353216
        ("FD_FAIL_R", whole(1084227584), 5.0),
        ("CA_ROTOR_COUNT", real(-8.0), -8.0),
        ("FD_FAIL_R", whole(60), None),
        ("FD_FAIL_R", whole(200), None),
        ("MC_AIRMODE", whole(-1), None),
        ("MC_AIRMODE", real(0.0), None),
        ("MC_AIRMODE", real(float("inf")), None),
        ("SYS_AUTOSTART", whole(4001), None),
    ],
)
def test_a_float_sent_as_an_int_is_stored_and_noticed(name: str, raw: bytes, meant: float | None) -> None:
    ground = Ground()
    assert float_in_disguise(ground.table.spec(name), raw) == meant
    ground.send("PARAM_SET", param_id=name, param_value=raw, param_type=INT32)
    assert ground.table.raw(name) == raw
    notices = ground.server.take_notices()
    assert len(notices) == (meant is not None)
    assert all(name in text and f"float {meant:g}" in text for text in notices)
    assert ground.server.take_notices() == []


@pytest.mark.parametrize(
    ("documented", "meant"),
    [
        ({}, 5.0),
        ({"minimum": 0}, None),
        ({"maximum": 2_000_000_000}, None),
        ({"values": {1084227584: "5.0 as four bytes"}}, None),
        ({"maximum": 100}, 5.0),
        ({"minimum": 2_000_000_000}, 5.0),
        ({"values": {5: "five"}}, 5.0),
    ],
)
def test_a_number_inside_what_is_documented_was_meant(documented: dict[str, Any], meant: float | None) -> None:
    assert float_in_disguise(ParameterSpec("X", "INT32", 0, **documented), struct.pack("<f", 5.0)) == meant


@pytest.mark.parametrize(
    ("number", "counts"),
    [(0.0015, True), (0.0009, False), (-0.0015, True), (1e6, True), (1.5e6, False), (float("inf"), False)],
)
def test_only_a_float_of_ordinary_size_was_meant(number: float, counts: bool) -> None:
    meant = float_in_disguise(ParameterSpec("X", "INT32", 0), struct.pack("<f", number))
    assert meant == (pytest.approx(number) if counts else None)


def test_the_first_and_the_last_index_are_read_and_the_one_behind_is_refused() -> None:
    ground = Ground()
    count = len(ground.table)
    for index in (0, count - 1):
        (answer,) = ground.ask("PARAM_REQUEST_READ", param_id="", param_index=index)
        assert (answer.param_id, answer.param_index) == (ground.table.names[index], index)
    (refusal,) = ground.ask("PARAM_REQUEST_READ", param_id="", param_index=count)
    assert (refusal.name, refusal.error, refusal.param_index) == ("PARAM_ERROR", 1, count)
    (refusal,) = ground.ask("PARAM_REQUEST_READ", param_id="NOBODY", param_index=-1)
    assert (refusal.name, refusal.error, refusal.param_index) == ("PARAM_ERROR", 1, 0)
    assert ground.server.refused == 2


def requested_list() -> Message:
    (message,) = Connection(1, 1).receive(
        Connection(255, 190).encode("PARAM_REQUEST_LIST", target_system=1, target_component=1)
    )
    return message


def test_bursts_keep_their_grid_whatever_the_tick_and_are_never_made_up_for() -> None:
    server = ParamServer(ParameterTable())
    server.handle(requested_list(), GROUND, 0)
    sent = {now_us: len(server.poll(GROUND, now_us)) for now_us in range(0, 25_000, 2_500)}
    # due at 0, 4, 8, 12, 16, 20 ms: at the first tick after each
    assert [now_us for now_us, count in sent.items() if count] == [0, 5_000, 10_000, 12_500, 17_500, 20_000]
    assert set(sent.values()) == {0, 20}
    assert len(server.poll(GROUND, 1_000_000)) == 20
    assert server.poll(GROUND, 1_001_999) == []
    assert len(server.poll(GROUND, 1_002_000)) == 20


def test_a_list_does_not_wait_for_an_announcement() -> None:
    server = ParamServer(ParameterTable())
    server.poll(GROUND, 0)
    server.table.set("MC_ROLL_P", 7.0)
    assert server.poll(GROUND, 1_000) == []
    server.handle(requested_list(), GROUND, 2_000)
    assert len(server.poll(GROUND, 2_000)) == 20
    # nor does it wait for what changes on the way
    server.table.set("MC_ROLL_P", 7.5)
    assert len(server.poll(GROUND, 6_000)) == 20


def test_a_second_change_does_not_put_off_the_first_ones_announcement() -> None:
    server = ParamServer(ParameterTable())
    server.poll(GROUND, 0)
    server.table.set("MC_ROLL_P", 7.0)
    assert server.poll(GROUND, 1_000) == []
    server.table.set("MC_PITCH_P", 7.0)
    assert server.poll(GROUND, 11_000) == []
    assert server.poll(GROUND, 20_999) == []
    assert [fields["param_id"] for _, fields in server.poll(GROUND, 21_000)] == ["MC_ROLL_P", "MC_PITCH_P"]


def test_of_many_notices_the_last_64_are_kept() -> None:
    ground = Ground()
    for number in range(70):
        raw = struct.pack("<f", 1000.0 + number)
        ground.send("PARAM_SET", param_id="MC_AIRMODE", param_value=raw, param_type=INT32)
    notices = ground.server.take_notices()
    assert len(notices) == 64
    assert "float 1006:" in notices[0]
    assert "float 1069:" in notices[-1]


def test_a_closed_link_is_forgotten() -> None:
    ground = Ground()
    ground.send("PARAM_REQUEST_LIST")
    ground.server.forget(GROUND)
    ground.wait(0.5)
    assert ground.heard[GROUND] == []
