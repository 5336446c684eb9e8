"""Both sides of the parameter protocol back to back, over a link that loses, doubles and delays."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable, Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.connection import Connection
from bridge.param_client import ParamClient
from bridge.param_operation import Outcome, ParamList, ParamOperation, ParamResult, ParamValue
from bridge.param_protocol import Outgoing, ParamServer
from sitl.errors import UsageError
from sitl.parameters import ParameterTable, UnstorableValue, WrongParameterType

TICK_US = 4_000
FOUR_BYTES = st.binary(min_size=4, max_size=4)
Vehicle = Callable[[list[Outgoing]], list[Outgoing]]


class Wire:
    """A client and a server, real frames between them, and a channel that misbehaves by seed.

    Args:
        loss: share of frames that vanish, each way.
        double: share that arrive twice.
        delay_s: longest delay; frames overtake each other.
        alter: changes what the vehicle says.
    """

    def __init__(
        self,
        *,
        loss: float = 0.0,
        double: float = 0.0,
        delay_s: float = 0.0,
        seed: int = 0,
        window: int = 10,
        alter: Vehicle = lambda out: out,
    ) -> None:
        self.table = ParameterTable()
        self.server = ParamServer(self.table)
        self.client = ParamClient(1, 1, window=window, own_system=255)
        self.now_us = 0
        self.loss, self.double, self.delay_s = loss, double, delay_s
        self.sent: list[Outgoing] = []
        self._alter = alter
        self._rng = random.Random(seed)
        self._up = (Connection(255, 190), Connection(1, 1))
        self._down = (Connection(1, 1), Connection(255, 190))
        self._flying: list[tuple[int, int, bool, bytes]] = []
        self._count = 0
        self.server.poll(0, 0)

    def tick(self) -> None:
        out = self.client.poll(self.now_us)
        self.sent += out
        self._launch(True, out)
        self._launch(False, self.server.poll(0, self.now_us))
        self._land()
        self.now_us += TICK_US

    def run(self, until: Callable[[], bool], limit_s: float = 60.0) -> float:
        """Tick until the condition holds; returns the vehicle time it took, s."""
        start = self.now_us
        while not until():
            assert self.now_us - start < limit_s * 1e6, "not finished in time"
            self.tick()
        return (self.now_us - start) / 1e6

    def finish(self, operations: Sequence[ParamOperation], limit_s: float = 60.0) -> list[ParamResult]:
        self.run(lambda: all(each.done for each in operations), limit_s)
        return [each.result for each in operations if each.result is not None]

    def set(self, name: str, value: float, read_back: bool = False) -> ParamOperation:
        return self.client.start_set(name, value, self.table.spec(name).type, read_back=read_back)

    def inject(self, delay_us: int, name: str, **fields: object) -> None:
        """A frame from the vehicle that arrives later, whatever the vehicle thinks by then."""
        self._fly(False, self._down[0].encode(name, **fields), delay_us)

    def _launch(self, up: bool, out: list[Outgoing]) -> None:
        for name, fields in out if up else self._alter(out):
            frame = (self._up if up else self._down)[0].encode(name, **fields)
            for _ in range(2 if self._rng.random() < self.double else 1):
                if self._rng.random() >= self.loss:
                    self._fly(up, frame, int(self._rng.random() * self.delay_s * 1e6))

    def _fly(self, up: bool, frame: bytes, delay_us: int) -> None:
        self._count += 1
        self._flying.append((self.now_us + delay_us, self._count, up, frame))

    def _land(self) -> None:
        due = sorted(each for each in self._flying if each[0] <= self.now_us)
        self._flying = [each for each in self._flying if each[0] > self.now_us]
        for _, _, up, frame in due:
            for message in (self._up if up else self._down)[1].receive(frame):
                if up:
                    self._launch(False, self.server.handle(message, 0, self.now_us))
                else:
                    self.client.handle(message, self.now_us)


def result_of(operation: ParamOperation) -> ParamResult:
    assert operation.result is not None
    return operation.result


@pytest.mark.parametrize("read_back", [False, True])
def test_set_and_read_on_a_clean_link(read_back: bool) -> None:
    wire = Wire()
    operation = wire.set("MC_ROLLRATE_P", 0.17, read_back)
    assert wire.client.busy
    (result,) = wire.finish([operation], 0.1)
    assert (result.outcome, result.reason, result.tries) == (Outcome.VERIFIED, "", 2 if read_back else 1)
    assert result.seen == result.wanted == ParamValue("REAL32", struct.pack("<f", 0.17))
    assert wire.table.get("MC_ROLLRATE_P") == struct.unpack("<f", struct.pack("<f", 0.17))[0]
    asked = [name for name, _ in wire.sent]
    assert asked == ["PARAM_SET", "PARAM_REQUEST_READ"][: 1 + read_back]
    read = wire.client.start_read("MC_ROLLRATE_P")
    wire.finish([read], 0.1)
    assert result_of(read).seen == result.wanted
    assert not wire.client.busy
    assert wire.client.poll(wire.now_us) == []


@given(FOUR_BYTES)
def test_every_bit_pattern_is_set_exactly_or_not_at_all(raw: bytes) -> None:
    wire = Wire()
    number = wire.client.start_set("FD_FAIL_R", struct.unpack("<i", raw)[0], "INT32", read_back=True)
    bits = wire.client.start_set("MC_ROLL_P", raw, "REAL32", read_back=True)
    wire.finish([number, bits], 0.2)
    assert result_of(number).outcome is result_of(bits).outcome is Outcome.VERIFIED
    assert wire.table.raw("FD_FAIL_R") == wire.table.raw("MC_ROLL_P") == raw


@given(st.floats(width=32))
def test_every_float32_is_verified_exactly(value: float) -> None:
    wire = Wire()
    operation = wire.client.start_set("MC_ROLL_P", value, "REAL32")
    (result,) = wire.finish([operation], 0.1)
    assert result.outcome is Outcome.VERIFIED
    assert wire.table.raw("MC_ROLL_P") == struct.pack("<f", value)


def test_the_same_bits_of_another_type_are_another_value() -> None:
    assert ParamValue("INT32", b"\0\0\0\0") != ParamValue("REAL32", b"\0\0\0\0")


@pytest.mark.parametrize(
    ("name", "value", "type_", "reason"),
    [
        ("NO_SUCH_PARAM", 1.0, "REAL32", "PARAM_ERROR 1 (does not exist)"),
        ("MC_AIRMODE", 1.0, "REAL32", "PARAM_ERROR 7 (type mismatch)"),
        ("_HASH_CHECK", 1, "INT32", "PARAM_ERROR 5 (read only)"),
    ],
)
def test_a_refusal_says_why_at_once(name: str, value: float, type_: str, reason: str) -> None:
    wire = Wire()
    operation = wire.client.start_set(name, value, "INT32" if type_ == "INT32" else "REAL32")
    (result,) = wire.finish([operation], 0.1)
    assert (result.outcome, result.reason, result.seen) == (Outcome.REFUSED, reason, None)


def test_a_corrected_set_right_after_a_refusal_is_not_refused_by_the_old_answer() -> None:
    wire = Wire()
    wire.finish([wire.client.start_set("MC_AIRMODE", 1.0, "REAL32")])
    refusal = {"target_system": 255, "target_component": 190, "param_id": "MC_AIRMODE", "error": 7}
    wire.inject(TICK_US, "PARAM_ERROR", **refusal)  # the first refusal once more, doubled on its way
    operation = wire.client.start_set("MC_AIRMODE", 1, "INT32")
    wire.loss = 1.0
    wire.tick()
    wire.loss = 0.0
    (result,) = wire.finish([operation])
    assert result.outcome is Outcome.VERIFIED


def test_a_refusal_for_another_ground_station_is_not_ours() -> None:
    wire = Wire(loss=1.0)
    operation = wire.set("MC_ROLL_P", 5.0)
    wire.inject(0, "PARAM_ERROR", target_system=245, target_component=190, param_id="MC_ROLL_P", error=1)
    wire.tick()
    assert not operation.done


def test_another_vehicles_answer_is_not_ours() -> None:
    wire = Wire(loss=1.0)
    operation = wire.set("MC_ROLL_P", 5.0)
    other = Connection(2, 1).encode("PARAM_VALUE", param_id="MC_ROLL_P", param_value=5.0, param_type=9, param_count=1)
    wire._fly(False, other, 0)
    wire.tick()
    assert not operation.done
    assert wire.client.known == {}


def test_a_dead_link_ends_in_a_timeout_after_five_tries() -> None:
    wire = Wire(loss=1.0)
    operations = [wire.set("MC_ROLL_P", 5.0), wire.client.start_read("MC_PITCH_P")]
    took = wire.run(lambda: all(each.done for each in operations))
    assert took == pytest.approx(2.5, abs=0.01)
    for operation in operations:
        result = result_of(operation)
        assert (result.outcome, result.tries, result.seen) == (Outcome.TIMEOUT, 5, None)
        assert result.reason == "no answer, asked 5 times in 2.5 s"


def test_a_vehicle_that_is_silent_on_unknown_names_times_out_with_a_hint() -> None:
    wire = Wire(alter=lambda out: [each for each in out if each[0] != "PARAM_ERROR"])
    operations = [wire.set("MC_ROLL_P", 5.0), wire.client.start_set("MC_OLD_NAME", 1.0, "REAL32")]
    good, bad = wire.finish(operations)
    assert good.outcome is Outcome.VERIFIED
    assert bad.outcome is Outcome.TIMEOUT
    assert "unknown name" in bad.reason


def test_a_vehicle_that_clamps_is_a_mismatch_with_the_value_it_keeps() -> None:
    def clamp(out: list[Outgoing]) -> list[Outgoing]:
        return [(name, {**fields, "param_value": struct.pack("<f", 0.5)}) for name, fields in out]

    wire = Wire(alter=clamp)
    (result,) = wire.finish([wire.set("MC_ROLLRATE_P", 0.9)])
    assert result.outcome is Outcome.MISMATCH
    assert result.seen == ParamValue("REAL32", struct.pack("<f", 0.5))
    assert "keeps 0.5" in result.reason
    assert result.tries == 5


def test_one_bit_off_is_not_success() -> None:
    def nudge(out: list[Outgoing]) -> list[Outgoing]:
        flip = [(name, dict(fields)) for name, fields in out]
        for _, fields in flip:
            raw = bytearray(fields["param_value"])
            raw[0] ^= 1
            fields["param_value"] = bytes(raw)
        return flip

    wire = Wire(alter=nudge)
    (result,) = wire.finish([wire.set("MC_ROLLRATE_P", 0.15)])
    assert result.outcome is Outcome.MISMATCH


def test_a_module_that_corrects_a_value_later_is_seen_as_drift() -> None:
    wire = Wire()
    wire.finish([wire.set("LNDMC_Z_VEL_MAX", 9.0)])
    assert wire.client.drifted() == {}
    wire.table.set("LNDMC_Z_VEL_MAX", 0.25)
    wire.run(lambda: bool(wire.client.drifted()), 1.0)
    ((wanted, heard),) = wire.client.drifted().values()
    assert (wanted.value, heard.value) == (9.0, 0.25)


def test_an_echo_of_another_parameter_is_no_success() -> None:
    wire = Wire(loss=1.0)
    operation = wire.set("MC_ROLL_P", 5.0)
    fields = {"param_value": struct.pack("<f", 5.0), "param_type": 9, "param_count": 9, "param_index": 1}
    wire.inject(0, "PARAM_VALUE", param_id="MC_PITCH_P", **fields)
    wire.inject(0, "PARAM_VALUE", param_id="MC_ROLL_P2", **fields)
    wire.inject(0, "PARAM_VALUE", param_id="MC_ROLL_P", **{**fields, "param_type": 6})  # same bits, other type
    wire.run(lambda: operation.done)
    assert result_of(operation).outcome is not Outcome.VERIFIED


@pytest.mark.parametrize("delay_ms", [0, 20, 100, 300, 480])
@pytest.mark.parametrize("read_back", [False, True])
def test_a_late_echo_of_an_older_set_is_no_success_of_the_newer(delay_ms: int, read_back: bool) -> None:
    """5, then 6, then 5 again: an old echo of the first 5 must not stand for the third set, which is lost."""
    wire = Wire()
    wire.finish([wire.set("MC_ROLL_P", 5.0)])
    five = {"param_value": struct.pack("<f", 5.0), "param_type": 9, "param_count": 9, "param_index": 1}
    for copy in range(3):
        wire.inject((delay_ms + copy) * 1000, "PARAM_VALUE", param_id="MC_ROLL_P", **five)
    wire.finish([wire.set("MC_ROLL_P", 6.0)])
    operation = wire.set("MC_ROLL_P", 5.0, read_back)
    wire.loss = 1.0
    wire.run(lambda: wire.now_us > 0.6e6)
    assert not operation.done
    assert wire.table.get("MC_ROLL_P") == 6.0
    wire.loss = 0.0
    (result,) = wire.finish([operation])
    assert result.outcome is Outcome.VERIFIED
    assert wire.table.get("MC_ROLL_P") == 5.0


def test_setting_the_value_it_has_is_verified_at_once() -> None:
    wire = Wire()
    for _ in range(3):
        operation = wire.set("MC_ROLL_P", 5.0)
        assert wire.run(lambda operation=operation: operation.done) < 0.02  # type: ignore[misc]
        wire.run(lambda: wire.now_us % 100_000 == 0)


def test_sets_of_one_name_go_in_order_and_never_overlap() -> None:
    wire = Wire(loss=0.2, delay_s=0.05, seed=3)
    operations = [wire.set("MC_ROLL_P", float(value)) for value in range(5, 12)]
    other = wire.set("MC_PITCH_P", 7.0)
    results = wire.finish([*operations, other])
    assert all(result.outcome is Outcome.VERIFIED for result in results)
    assert wire.table.get("MC_ROLL_P") == 11.0
    sent = [fields["param_value"] for name, fields in wire.sent if fields.get("param_id") == "MC_ROLL_P"]
    assert sent == sorted(sent, key=lambda raw: float(struct.unpack("<f", raw)[0]))


def hundred(wire: Wire, read_back: bool) -> list[ParamOperation]:
    rng = random.Random(1)
    return [wire.set(name, rng.randrange(1, 9), read_back) for name in wire.table.names[:100]]


def test_a_hundred_parameters_go_up_in_a_moment_on_a_clean_link() -> None:
    wire = Wire(delay_s=0.002)
    operations = hundred(wire, read_back=True)
    took = wire.run(lambda: all(each.done for each in operations))
    assert took < 0.3
    assert all(result_of(each).outcome is Outcome.VERIFIED for each in operations)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("read_back", [False, True])
def test_a_hundred_parameters_go_up_over_a_link_that_loses_three_of_ten(seed: int, read_back: bool) -> None:
    wire = Wire(loss=0.3, double=0.1, delay_s=0.1, seed=seed)
    operations = hundred(wire, read_back)
    took = wire.run(lambda: all(each.done for each in operations))
    assert took < 20.0
    for operation in operations:
        result = result_of(operation)
        assert result.outcome is Outcome.VERIFIED
        assert result.wanted is not None
        assert wire.table.raw(operation.name) == result.wanted.raw


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    loss=st.floats(0.0, 0.9),
    values=st.lists(st.sampled_from([1.0, 2.0, 3.0]), min_size=1, max_size=8),
    read_back=st.booleans(),
)
def test_verified_means_the_vehicle_holds_it(seed: int, loss: float, values: list[float], read_back: bool) -> None:
    """Few values, set again and again while packets double, vanish and overtake: no false success, ever."""
    wire = Wire(loss=loss, double=0.3, delay_s=0.4, seed=seed)
    for value in values:
        operation = wire.set("MC_ROLL_P", value, read_back)
        (result,) = wire.finish([operation])
        assert result.outcome in (Outcome.VERIFIED, Outcome.TIMEOUT, Outcome.MISMATCH)
        if result.outcome is Outcome.VERIFIED:
            assert wire.table.get("MC_ROLL_P") == value


def test_window_bounds_what_is_in_flight() -> None:
    wire = Wire(loss=1.0, window=4)
    for name in wire.table.names[:20]:
        wire.set(name, 1)
    wire.tick()
    assert len(wire.sent) == 4


def everything(wire: Wire) -> tuple[ParamList, float]:
    reading = wire.client.start_read_all()
    took = wire.run(lambda: reading.done)
    return reading, took


def test_read_all_gives_every_value_and_the_hash() -> None:
    wire = Wire()
    wire.table.set("MC_AIRMODE", -1)
    wire.table.set_raw("MC_ROLL_P", b"\x01\x00\x80\x7f")  # a signalling NaN
    reading, took = everything(wire)
    assert reading.outcome is Outcome.VERIFIED
    assert {name: value.raw for name, value in reading.values.items()} == {
        name: wire.table.raw(name) for name in wire.table
    }
    assert all(value.type == wire.table.spec(name).type for name, value in reading.values.items())
    assert reading.values["MC_AIRMODE"].value == -1
    assert wire.client.hash == wire.table.hash_check()
    assert took < 0.2
    assert [name for name, _ in wire.sent] == ["PARAM_REQUEST_LIST"]


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("loss", [0.05, 0.3])
def test_read_all_fills_the_gaps(seed: int, loss: float) -> None:
    wire = Wire(loss=loss, double=0.1, delay_s=0.05, seed=seed)
    reading, took = everything(wire)
    assert reading.outcome is Outcome.VERIFIED
    assert {name: value.raw for name, value in reading.values.items()} == {
        name: wire.table.raw(name) for name in wire.table
    }
    assert took < 20.0


def test_read_all_of_a_dead_link_says_so() -> None:
    reading, took = everything(Wire(loss=1.0))
    assert (reading.outcome, reading.values) == (Outcome.TIMEOUT, {})
    assert took == pytest.approx(2.5, abs=0.01)
    assert reading.reason == "no answer to 5 list requests in 2.5 s"


def test_read_all_of_a_vehicle_that_withholds_one_names_the_gap() -> None:
    wire = Wire(alter=lambda out: [each for each in out if each[1].get("param_index") != 17])
    reading, _ = everything(wire)
    assert reading.outcome is Outcome.TIMEOUT
    assert reading.missing == [17]
    assert f"1 of {len(wire.table)} parameters are missing (first index 17)" in reading.reason


def test_read_all_starts_over_when_the_list_changes_on_the_way() -> None:
    wire = Wire()
    reading = wire.client.start_read_all()
    early = {
        "param_id": "GONE",
        "param_value": b"\0\0\0\0",
        "param_type": 6,
        "param_count": 3,
        "param_index": 0,
    }
    wire.inject(0, "PARAM_VALUE", **early)
    wire.run(lambda: reading.done)
    assert reading.outcome is Outcome.VERIFIED
    assert set(reading.values) == set(wire.table.names)


def test_read_all_takes_values_that_are_set_meanwhile() -> None:
    wire = Wire()
    reading = wire.client.start_read_all()
    wire.tick()
    wire.finish([wire.set("CA_METHOD", 1)])
    wire.run(lambda: reading.done)
    assert reading.values["CA_METHOD"].value == 1


@pytest.mark.parametrize("name", ["", "A2345678901234567", "MC_RÖLL_P"])
def test_names_that_cannot_be_sent_are_refused_here(name: str) -> None:
    client = ParamClient(1, 1)
    with pytest.raises(UsageError, match="1 to 16"):
        client.start_set(name, 1.0, "REAL32")
    with pytest.raises(UsageError, match="1 to 16"):
        client.start_read(name)


def test_values_that_cannot_be_sent_are_refused_here() -> None:
    client = ParamClient(1, 1)
    with pytest.raises(WrongParameterType):
        client.start_set("MC_AIRMODE", 1.0, "INT32")
    with pytest.raises(UnstorableValue):
        client.start_set("MC_ROLL_P", 1e39, "REAL32")
    with pytest.raises(WrongParameterType):
        client.start_set("MC_ROLL_P", b"12345", "REAL32")
    assert not client.busy


@given(seed=st.integers(0, 2**32), count=st.integers(0, 65535), index=st.integers(0, 65535), raw=FOUR_BYTES)
def test_a_vehicle_that_talks_nonsense_never_breaks_the_client(seed: int, count: int, index: int, raw: bytes) -> None:
    rng = random.Random(seed)
    wire = Wire(loss=1.0)
    reading = wire.client.start_read_all()
    operation = wire.set("MC_ROLL_P", 5.0)
    for _ in range(20):
        fields = {"param_id": rng.randbytes(16), "param_value": raw, "param_type": rng.randrange(256)}
        wire.inject(0, "PARAM_VALUE", param_count=count, param_index=index, **fields)
        wire.inject(0, "PARAM_ERROR", target_system=255, param_id=rng.randbytes(16), error=rng.randrange(256))
        wire.tick()
    assert not operation.done
    assert reading.outcome in (None, Outcome.VERIFIED)
