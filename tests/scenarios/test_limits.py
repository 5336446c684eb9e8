"""Limits and the verdict."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from scenarios.limits import LIMIT_SETS, METRICS, Limit, Outcome, judge, measured, parse_limits
from sitl.errors import FileError

GOOD = (
    measured("oscillation_rad_s", 0.01),
    measured("overshoot_pct", 3.0),
    measured("rise_time_s", 0.2),
    measured("delay_margin_s", 0.012),
    measured("vaf_pct", 80.0),
)


def changed(name: str, value: float | None, reason: str = "") -> tuple[Any, ...]:
    return tuple(measured(name, value, reason) if m.name == name else m for m in GOOD)


def test_pass_marks_limited_metrics_and_leaves_the_rest() -> None:
    outcome, reason, metrics = judge(GOOD, LIMIT_SETS["practical"])
    assert (outcome, reason) == (Outcome.PASS, "")
    by_name = {metric.name: metric for metric in metrics}
    assert by_name["overshoot_pct"].outcome is Outcome.PASS
    assert by_name["overshoot_pct"].limit == "<= 10 %"
    assert by_name["delay_margin_s"].limit == ">= 0.01 s"
    assert by_name["vaf_pct"].outcome is Outcome.INFO
    assert by_name["vaf_pct"].limit is None


@pytest.mark.parametrize(("value", "outcome"), [(9.999, "PASS"), (10.0, "PASS"), (10.001, "FAIL")])
def test_limits_are_inclusive(value: float, outcome: str) -> None:
    assert judge(changed("overshoot_pct", value), LIMIT_SETS["practical"])[0] is Outcome(outcome)


def test_infinite_margin_passes_a_minimum() -> None:
    assert judge(changed("delay_margin_s", float("inf")), LIMIT_SETS["practical"])[0] is Outcome.PASS


def test_failures_name_value_and_limit() -> None:
    outcome, reason, _ = judge(changed("delay_margin_s", 0.0042), LIMIT_SETS["practical"])
    assert outcome is Outcome.FAIL
    assert reason == "delay margin 4.2 ms, limit >= 10 ms"


def test_an_unmeasured_limited_metric_is_unset_not_failed() -> None:
    outcome, reason, _ = judge(changed("rise_time_s", None, "never reaches 90 %"), LIMIT_SETS["practical"])
    assert outcome is Outcome.UNSET
    assert reason == "rise time unset: never reaches 90 %"


def test_a_limit_on_something_never_measured_is_listed_as_unset() -> None:
    outcome, reason, metrics = judge(GOOD, (Limit("lag_s", maximum=0.2),))
    assert outcome is Outcome.UNSET
    assert reason == "lag unset: not measured in this scenario"
    assert metrics[-1].name == "lag_s"
    assert metrics[-1].outcome is Outcome.UNSET


def test_fail_beats_unset() -> None:
    metrics = [m for m in changed("overshoot_pct", 40.0) if m.name != "rise_time_s"]
    outcome, reason, _ = judge(metrics, LIMIT_SETS["practical"])
    assert outcome is Outcome.FAIL
    assert reason == "overshoot 40 %, limit <= 10 %"


@pytest.mark.parametrize("limits", [(), (Limit("vaf_pct", minimum=50.0),), LIMIT_SETS["study"]])
def test_no_list_of_limits_lets_a_limit_cycle_pass(limits: tuple[Limit, ...]) -> None:
    shaking = changed("oscillation_rad_s", 3.3, "limit cycle 8.4 Hz, 3.3 rad/s in roll")
    outcome, reason, _ = judge(shaking, limits)
    assert outcome is Outcome.FAIL
    assert "limit cycle 8.4 Hz, 3.3 rad/s in roll" in reason


def test_the_scenario_may_set_its_own_oscillation_limit() -> None:
    shaking = changed("oscillation_rad_s", 0.5, "limit cycle")
    assert judge(shaking, (Limit("oscillation_rad_s", maximum=1.0),))[0] is Outcome.PASS


def test_a_failed_flight_fails_whatever_was_measured() -> None:
    outcome, reason, _ = judge(GOOD, LIMIT_SETS["practical"], failure="diverged: roll beyond 80 deg at 12.00 s")
    assert outcome is Outcome.FAIL
    assert reason == "diverged: roll beyond 80 deg at 12.00 s"


def test_without_limits_there_is_no_verdict() -> None:
    assert judge(GOOD, ())[0:2] == (Outcome.INFO, "no limits set")


def test_limits_apply_to_the_flight_not_to_a_segment() -> None:
    metrics = (*GOOD, measured("overshoot_pct", 90.0, segment="step"))
    outcome, _, judged = judge(metrics, LIMIT_SETS["practical"])
    assert outcome is Outcome.PASS
    assert judged[-1].outcome is Outcome.INFO


def test_every_limit_set_limits_known_metrics() -> None:
    for limits in LIMIT_SETS.values():
        assert {limit.metric for limit in limits} <= set(METRICS)


def test_the_sets_are_those_the_readme_prints() -> None:
    printed = {name: [(limit.metric, str(limit)) for limit in limits] for name, limits in LIMIT_SETS.items()}
    assert printed == {
        "practical": [
            ("oscillation_rad_s", "<= 0.3 rad/s"),
            ("overshoot_pct", "<= 10 %"),
            ("rise_time_s", "<= 0.4 s"),
            ("delay_margin_s", ">= 0.01 s"),
        ],
        "study": [
            ("oscillation_rad_s", "<= 0.3 rad/s"),
            ("settling_time_5pct_s", "<= 0.5 s"),
            ("overshoot_pct", "<= 0.15 %"),
        ],
        "none": [],
    }


@pytest.mark.parametrize(
    ("limit", "inside", "outside"),
    [
        (Limit("droop_deg", -3.0, 3.0), (-3.0, 0.0, 3.0), (-3.001, 3.001)),
        (Limit("droop_deg", minimum=0.0), (0.0, 1e9), (-1e-9,)),
        (Limit("droop_deg", maximum=0.0), (0.0, -1e9), (1e-9,)),
    ],
)
def test_both_ends_belong_to_a_limit(limit: Limit, inside: tuple[float, ...], outside: tuple[float, ...]) -> None:
    assert all(limit.holds(value) for value in inside)
    assert not any(limit.holds(value) for value in outside)


def test_a_failure_names_everything_that_failed_and_what_is_known_of_it() -> None:
    metrics = (
        measured("oscillation_rad_s", 0.5),
        measured("overshoot_pct", 40.0, "first step"),
        measured("peak_delta_lat", 0.7),
        measured("lag_s", None, "the lag exceeds 1 s"),
    )
    limits = (
        Limit("overshoot_pct", maximum=10.0),
        Limit("peak_delta_lat", maximum=0.5),
        Limit("lag_s", maximum=0.2),
        Limit("vaf_pct", minimum=60.0),
    )
    outcome, reason, judged = judge(metrics, limits, failure="timed out")
    assert outcome is Outcome.FAIL
    assert reason == (
        "timed out; oscillation 0.5 rad/s, limit <= 0.3 rad/s; overshoot 40 %, limit <= 10 % (first step); "
        "peak delta_lat 0.7, limit <= 0.5"
    )
    assert [(one.name, one.limit, str(one.outcome)) for one in judged] == [
        ("oscillation_rad_s", "<= 0.3 rad/s", "FAIL"),
        ("overshoot_pct", "<= 10 %", "FAIL"),
        ("peak_delta_lat", "<= 0.5", "FAIL"),
        ("lag_s", "<= 0.2 s", "UNSET"),
        ("vaf_pct", ">= 60 %", "UNSET"),
    ]
    rest = judge((measured("oscillation_rad_s", 0.1), metrics[3]), limits[2:])
    assert rest[:2] == (
        Outcome.UNSET,
        "lag unset: the lag exceeds 1 s; VAF unset: not measured in this scenario",
    )


def test_what_is_no_number_was_not_measured() -> None:
    unset = measured("lag_s", float("nan"), "why", "step/1")
    assert (unset.value, unset.outcome, unset.unit, unset.reason, unset.segment) == (
        None, Outcome.UNSET, "s", "why", "step/1",
    )  # fmt: skip
    assert measured("lag_s", 0.1, "how", "step/1").outcome is Outcome.INFO


def test_parse_limits() -> None:
    parsed = parse_limits([{"metric": "vaf_pct", "min": 60}, {"metric": "droop_deg", "min": -3, "max": 3}], "f")
    assert parsed == (Limit("vaf_pct", 60.0), Limit("droop_deg", -3.0, 3.0))
    assert parse_limits([{"metric": "lag_s", "min": 0, "max": 0}], "f") == (Limit("lag_s", 0.0, 0.0),)
    assert parse_limits([], "f") == ()
    assert str(parsed[1]) == ">= -3 deg and <= 3 deg"
    assert parse_limits("study", "f") is LIMIT_SETS["study"]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ("practicle", 'did you mean "practical"?'),
        (7, "neither a name nor a list"),
        ([{"metric": "overshot_pct", "max": 1}], 'did you mean "overshoot_pct"?'),
        ([{"metric": "vaf_pct"}], "has no bound"),
        ([{"metric": "vaf_pct", "maks": 1}], "unknown key 'maks'"),
        ([{"metric": "vaf_pct", "max": float("nan")}], "not a finite number"),
        ([{"metric": "vaf_pct", "max": True}], "not a finite number"),
        ([{"metric": "vaf_pct", "min": 2, "max": 1}], "exceeds max"),
        ([{"metric": "vaf_pct", "min": 2}, {"metric": "vaf_pct", "max": 1}], "limited twice"),
        ([{"max": 1}], "has no metric"),
        ([7], "limit 1 has no metric"),
        ([{"metric": "vaf_pct", "max": 1}, {"max": 1}], "limit 2 has no metric"),
        ([{"metric": "vaf_pct", "min": "1"}], "min = '1' is not a finite number"),
        ([{"metric": "vaf_pct", "min": 0, "max": float("inf")}], "max = inf is not a finite number"),
    ],
)
def test_bad_limits_name_the_mistake(value: Any, text: str) -> None:
    with pytest.raises(FileError) as error:
        parse_limits(value, Path("my.toml"))
    assert str(error.value).startswith("my.toml: ")
    assert text in str(error.value)
