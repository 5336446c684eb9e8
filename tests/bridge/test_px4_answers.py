"""Our vehicle answers as a real PX4 did: recorded cases replayed in vehicle time, and tests of that comparison."""

from __future__ import annotations

import copy
import re
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parents[1]))

import px4_answers
import px4_compare
import px4_rig

from bridge.connection import Connection

Json = dict[str, Any]

CASES = px4_answers.load_cases()
DEVIATIONS = px4_answers.load_deviations()
ASKED = [case for case in CASES if "answers" in case and not case.get("informative")]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case["id"])
def test_answers_as_a_px4(case: Json) -> None:
    wrong = px4_answers.replay(case, DEVIATIONS).wrong
    assert not wrong, f"{case['desc']}:\n" + "\n".join(wrong)


def test_deviations_are_of_cases_and_have_a_reason() -> None:
    ids = [case["id"] for case in CASES]
    for deviation in DEVIATIONS:
        assert len(deviation.reason) > 20
        assert deviation.differences
        for pattern in deviation.cases:
            assert any(re.fullmatch(pattern, one) for one in ids), f"{pattern!r} matches no case"


# The comparison itself


def recorded(case: Json) -> Json:
    """What was recorded, as if our vehicle had answered it."""
    return copy.deepcopy({key: case[key] for key in ("answers", "end", "first", "rates") if key in case})


def test_a_recording_does_not_differ_from_itself() -> None:
    assert {case["id"]: lines for case in ASKED if (lines := px4_compare.differences(case, recorded(case)))} == {}


def test_connect_and_rates_of_the_recording_show_no_difference_and_others_do() -> None:
    for case in CASES:
        if case.get("kind") not in ("connect", "rates"):
            continue
        got = recorded(case)
        if case["kind"] == "rates":
            got["rates"] = {name: pair[0] for name, pair in got["rates"].items()}
            assert px4_compare.differences(case, got) == []
            (line,) = px4_compare.differences(case, {"rates": {**got["rates"], "ATTITUDE": 5.0}})
            assert re.fullmatch(r"rate ATTITUDE: expected .* Hz, got 5.0", line)
            assert px4_compare.differences(case, {"rates": {**got["rates"], "RAW_IMU": 1.0}}) == [
                "rate RAW_IMU: not expected, got 1.0"
            ]
        else:
            assert px4_compare.differences(case, got) == []
            heartbeat = next(one for one in got["first"] if one["name"] == "HEARTBEAT")
            got["first"] = [heartbeat | {"fields": heartbeat["fields"] | {"autopilot": 3}}, {"name": "RAW_IMU"}]
            lines = px4_compare.differences(case, got)
            assert "HEARTBEAT.autopilot: expected 12, got 3" in lines
            assert "extra RAW_IMU" in lines
            assert sum(line.startswith("missing ") for line in lines) > 10


@given(st.data())
def test_an_answer_that_is_missing_changed_or_too_many_is_seen(data: st.DataObject) -> None:
    case = data.draw(st.sampled_from([case for case in ASKED if "COMMAND_ACK" in names(case)]))
    got = recorded(case)
    at = data.draw(st.sampled_from([k for k, one in enumerate(got["answers"]) if one["name"] == "COMMAND_ACK"]))
    change = data.draw(st.sampled_from(["gone", "result", "target", "another", "twice"]))
    one = got["answers"][at]
    expected = px4_compare.show(one)
    if change == "gone":
        del got["answers"][at]
        expected = f"missing {expected}"
    elif change == "result":
        one["fields"]["result"] = 77
        expected = f"missing {expected}"
    elif change == "target":
        one["fields"]["target_system"] = 77
        expected = "COMMAND_ACK.target_system: expected "
    elif change == "another":
        got["answers"].append({**one, "fields": {**one["fields"], "command": 4711}})
        expected = "extra COMMAND_ACK 4711"
    else:
        one["count"] = one.get("count", 1) + 1
        expected = f"{expected}: expected {one['count'] - 1} times" if not case.get("loose_count") else ""
    assert any(line.startswith(expected) for line in px4_compare.differences(case, got)) or not expected


def names(case: Json) -> set[str]:
    return {one["name"] for one in case["answers"]}


def test_the_end_and_the_times_of_a_timeline_are_compared() -> None:
    case = next(case for case in ASKED if case.get("timeline") and "STATUSTEXT" in names(case))
    got = recorded(case)
    text = next(one for one in got["answers"] if one["name"] == "STATUSTEXT")
    text["t"] += 5.0
    got["end"]["custom_mode"] = 1
    lines = px4_compare.differences(case, got)
    assert len(lines) == 2
    assert re.search(r"STATUSTEXT .*: expected at .* s, got", lines[0])
    assert lines[1] == f"end HEARTBEAT.custom_mode: expected {case['end']['custom_mode']}, got 1"


def test_numbers_in_texts_and_what_varies_are_not_compared() -> None:
    text = {"severity": 4, "text": "Climb to 12.5 m", "id": 3, "chunk_seq": 0}
    theirs = {"t": 0.1, "step": 0, "name": "STATUSTEXT", "fields": text, "build": ["id"], "vary": ["severity"]}
    case = {"pre": "ground", "steps": [], "answers": [theirs], "end": {}}
    mine = {**theirs, "fields": {**text, "text": "Climb to 9 m", "id": 8, "severity": 6}}
    assert px4_compare.differences(case, {"answers": [mine], "end": {}}) == []
    mine = {**theirs, "fields": {**text, "text": "Sink to 9 m"}}
    assert px4_compare.differences(case, {"answers": [mine], "end": {}}) == [
        "missing STATUSTEXT 4 'Climb to 12.5 m'",
        "extra STATUSTEXT 4 'Sink to 9 m'",
    ]


def test_an_answer_at_the_edge_of_the_window_may_count() -> None:
    fields = {"command": 400, "result": 0}
    theirs = {"t": 0.1, "step": 0, "name": "COMMAND_ACK", "fields": fields, "count": 2}
    case = {"pre": "ground", "steps": [], "answers": [theirs], "end": {}}
    one = {"t": 0.1, "step": 0, "name": "COMMAND_ACK", "fields": fields}
    late = {**one, "t": 0.6, "late": True}
    for answers, wrong in (([one, one], 0), ([one, late], 0), ([one, one, late], 0), ([one], 1), ([one] * 3, 1)):
        got = {"answers": px4_compare.squeeze(answers), "end": {}}
        assert len(px4_compare.differences(case, got)) == wrong
    alone = {"answers": [late], "end": {}}
    assert px4_compare.differences({**case, "answers": [{**theirs, "count": 1}]}, alone) == []
    assert px4_compare.differences({**case, "answers": []}, alone) == []


def test_many_of_one_message_become_a_summary() -> None:
    answers = [
        {"t": k * 0.01, "step": 0, "name": "PARAM_VALUE", "fields": {"param_id": f"P{k:03}", "param_index": k}}
        for k in range(50)
    ]
    (summary,) = px4_compare.squeeze(answers)
    assert (summary["n"], summary["first"]["param_id"], summary["last"]["param_id"]) == (50, "P000", "P049")
    assert (summary["hash_checks"], summary["in_index_order"], summary["sorted_by_name"]) == (0, True, True)
    assert px4_compare.squeeze(answers[::-1])[0]["in_index_order"] is False


# Deviations


def test_a_new_difference_fails_and_a_stale_deviation_too() -> None:
    meant = px4_answers.Deviation("a reason", ("mode-.*",), ("missing A", "B.t: expected *, got (x)"))
    lines = ["missing A", "B.t: expected 3, got (x)"]
    assert px4_answers.judge("mode-1", lines, [meant]) == (lines, [])
    assert px4_answers.judge("mode-1", [*lines, "extra C"], [meant]) == (lines, ["extra C"])
    assert px4_answers.judge("mode-1", lines[:1], [meant]) == (
        lines[:1],
        ["stale: the deviation 'B.t: expected *, got (x)' does not occur"],
    )
    assert px4_answers.judge("not-mode-1", lines, [meant]) == ([], lines)


# Values


def over_the_wire(name: str, fields: Json) -> Json:
    """A recorded request as its receiver would record it."""
    frame = Connection(255, 190).encode_fields(name, px4_rig.to_wire({"name": name, "fields": fields}, {}))
    (message,) = Connection(1, 1, datagram=True).receive(frame)
    return px4_rig.from_wire(message)


def test_requests_arrive_as_they_were_recorded() -> None:
    steps = [step for case in CASES for part in ("setup", "steps", "auto") for step in case.get(part, ())]
    requests = [one for step in steps for one in [*step.get("send", ()), *(step.get("stream") or {}).get("msgs", ())]]
    for request in requests:
        fields = {key: value for key, value in request["fields"].items() if "$" not in repr(value)}
        heard = over_the_wire(request["name"], fields)
        for key, value in fields.items():
            if key == "payload":
                assert all(heard[key][part] == value[part] for part in ("seq", "opcode", "offset") if part in value)
                if "size" not in value and not value.get("data", "").startswith("hex:"):
                    assert heard[key].get("data", "") == value.get("data", "")
            elif isinstance(value, (int, float)):
                assert heard[key] == pytest.approx(value, rel=1e-6)
            elif isinstance(value, str):
                assert heard[key] == value[:16]
            elif isinstance(value, dict) and fields["param_type"] in range(1, 7):
                assert heard[key] == value
    assert len(requests) > 500


@given(st.integers(-(2**31), 2**31 - 1))
def test_an_integer_parameter_keeps_all_its_bits(number: int) -> None:
    fields = {"param_id": "X", "param_value": {"i32": number}, "param_type": 6}
    assert over_the_wire("PARAM_SET", fields)["param_value"] == {"i32": number}
