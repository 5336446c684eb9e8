"""The states of what the ground asks for, on their own and to the microsecond; `test_param_client` drives them."""

from __future__ import annotations

import pytest

from bridge.param_operation import TIMEOUT_US, Outcome, ParamList, ParamOperation, ParamValue
from sitl.parameters import to_raw

VALUE = ParamValue("INT32", b"\1\0\0\0")
TARGET = {"target_system": 3, "target_component": 1}
WHOLE = [("PARAM_REQUEST_LIST", TARGET)]


def reads(*indices: int) -> list[tuple[str, dict[str, object]]]:
    return [("PARAM_REQUEST_READ", {**TARGET, "param_id": "", "param_index": index}) for index in indices]


def begun(count: int, came: int, *, now_us: int = 0) -> ParamList:
    """A reading that was asked for at 0 and of whose `count` values the first `came` have come."""
    reading = ParamList(3, 1)
    assert reading.poll(0) == WHOLE
    for index in range(came):
        reading.heard(index, f"P{index}", VALUE, count, now_us)
    return reading


@pytest.mark.parametrize(
    ("type_", "value", "text"),
    [("INT32", 2147483647, "2147483647"), ("REAL32", 0.1, "0.100000001"), ("REAL32", 2.0, "2")],
)
def test_a_value_as_text_has_the_digits_that_tell_it_from_others(type_: str, value: float, text: str) -> None:
    assert str(ParamValue(type_, to_raw("MC_ROLL_P", type_, value))) == text


def test_an_operation_begins_with_nothing_done_and_without_reading_back() -> None:
    operation = ParamOperation("MC_ROLL_P", VALUE)
    assert (operation.done, operation.read_back, operation.reading) == (False, False, False)
    assert (operation.tries, operation.contrary, operation.differed, operation.seen) == (0, 0, False, None)
    assert ParamOperation("MC_ROLL_P", None).reading


def test_a_list_is_asked_for_at_once_and_again_after_half_a_second() -> None:
    reading = ParamList(3, 1)
    assert (reading.done, reading.missing, reading.reason, reading.count) == (False, [], "", None)
    assert reading.poll(0) == WHOLE
    assert reading.poll(TIMEOUT_US - 1) == []
    assert reading.poll(TIMEOUT_US) == WHOLE


def test_the_first_answer_gives_the_list_its_time_whatever_it_is() -> None:
    reading = begun(3, 0)
    reading.heard(None, "", None, 3, 400_000)
    assert reading.missing == [0, 1, 2]
    assert reading.poll(400_000 + TIMEOUT_US - 1) == []
    assert reading.poll(400_000 + TIMEOUT_US) == WHOLE


def test_what_is_missing_is_asked_for_when_nothing_came_for_half_a_second() -> None:
    reading = begun(3, 1, now_us=300_000)
    assert reading.poll(300_000 + TIMEOUT_US - 1) == []
    assert reading.poll(300_000 + TIMEOUT_US) == reads(1, 2)


def test_gaps_are_asked_for_in_windows_of_ten_the_next_one_as_soon_as_the_last_is_filled() -> None:
    reading = begun(14, 1)
    assert reading.poll(TIMEOUT_US) == reads(*range(1, 11))
    for index in range(1, 10):
        reading.heard(index, f"P{index}", VALUE, 14, TIMEOUT_US + 1000)
    assert reading.poll(TIMEOUT_US + 1000) == []
    reading.heard(10, "P10", VALUE, 14, TIMEOUT_US + 2000)
    assert reading.poll(TIMEOUT_US + 1999) == []
    assert reading.poll(TIMEOUT_US + 2000) == reads(11, 12, 13)


def test_a_value_that_is_known_does_not_put_off_the_next_request() -> None:
    reading = begun(3, 1)
    reading.heard(0, "P0", VALUE, 3, TIMEOUT_US - 1)
    assert reading.poll(TIMEOUT_US) == reads(1, 2)


@pytest.mark.parametrize(("missing", "asked"), [(40, reads(*range(1, 11))), (41, WHOLE)])
def test_more_than_forty_gaps_are_a_list_asked_for_again(missing: int, asked: list[object]) -> None:
    assert begun(1 + missing, 1).poll(TIMEOUT_US) == asked


def test_a_list_that_changed_has_no_gaps_yet() -> None:
    # what was asked for one by one is forgotten: the values of the new list put off the next request
    reading = begun(2, 1)
    assert reading.poll(TIMEOUT_US) == reads(1)
    reading.heard(None, "", None, 3, 2 * TIMEOUT_US)  # the list grew and begins anew
    assert reading.poll(2 * TIMEOUT_US) == WHOLE
    reading.heard(1, "P1", VALUE, 3, 2 * TIMEOUT_US + 1000)
    assert reading.poll(3 * TIMEOUT_US + 999) == []
    assert reading.poll(3 * TIMEOUT_US + 1000) == reads(0, 2)


def test_a_list_that_changed_its_length_is_asked_for_at_once() -> None:
    reading = begun(3, 2, now_us=1000)
    reading.heard(None, "", None, 4, 2000)
    assert (reading.values, reading.missing) == ({}, [0, 1, 2, 3])
    assert reading.poll(1999) == []
    assert reading.poll(2000) == WHOLE


def test_an_index_beyond_the_list_is_no_value() -> None:
    reading = begun(3, 0)
    reading.heard(3, "P3", VALUE, 3, 1000)
    reading.heard(None, "P4", VALUE, 3, 1000)
    assert reading.values == {}
    assert reading.missing == [0, 1, 2]


def test_a_name_under_two_indices_begins_the_list_anew() -> None:
    reading = begun(2, 1)
    reading.heard(1, "P0", VALUE, 2, 1000)
    assert not reading.done
    assert reading.poll(1000) == WHOLE


@pytest.mark.parametrize(("came", "rounds", "reason"), [
    (None, 5, "no answer to 5 list requests in 2.5 s"),
    (2, 15, "1 of 3 parameters are missing (first index 2), nothing new for 7.5 s"),
])  # fmt: skip
def test_rounds_that_bring_nothing_end_it(came: int | None, rounds: int, reason: str) -> None:
    reading = begun(3, came or 0)
    now_us, sent = 0, 0 if came else 1
    while not reading.done:
        now_us += TIMEOUT_US
        sent += len(reading.poll(now_us))
    assert (sent, now_us) == (rounds, (rounds + (1 if came else 0)) * TIMEOUT_US)
    assert (reading.outcome, reading.reason) == (Outcome.TIMEOUT, reason)
    assert reading.poll(now_us + TIMEOUT_US) == []


def test_what_comes_after_the_end_is_not_taken() -> None:
    reading = begun(1, 1)
    assert (reading.outcome, reading.reason) == (Outcome.VERIFIED, "")
    reading.heard(0, "P1", VALUE, 1, 1000)
    assert set(reading.values) == {"P0"}
