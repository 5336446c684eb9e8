"""run.json of older programs, and the shape that whatever was read is brought to."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scenarios.run_folder import run_object
from scenarios.run_schema import SCHEMA_VERSION, STEPS, NewerError, migrate
from scenarios.run_shape import FLIGHT, MOST_TOLD, RUN, conform, nothing
from sitl.errors import FileError

FILE = Path("run.json")


@pytest.fixture(scope="module")
def written(flown_run: Any) -> dict[str, Any]:
    """What the present program writes, as read back; this one's vehicle is described by halves only."""
    return conform(json.loads(json.dumps(run_object(flown_run))))[0]


def test_no_version_between_the_first_and_the_present_is_left_out() -> None:
    assert sorted(STEPS) == list(range(1, SCHEMA_VERSION))


def test_a_run_of_the_first_version_becomes_one_of_the_present(written: dict[str, Any]) -> None:
    old = {key: value for key, value in written.items() if key != "twins"} | {"schema_version": 1}
    before = copy.deepcopy(old)
    present = migrate(old, FILE)
    assert present == written
    assert old == before  # the caller's own is left alone
    assert conform(present) == (written, ())


@pytest.mark.parametrize("version", [SCHEMA_VERSION + 1, 10**30])
def test_a_run_of_a_newer_program_is_refused(version: int) -> None:
    with pytest.raises(NewerError, match="written by a newer froude") as error:
        migrate({"schema_version": version}, FILE)
    assert "run.json: schema_version is" in str(error.value)


@pytest.mark.parametrize(
    "run", [None, [], "run", 3, {}, *({"schema_version": v} for v in (None, "2", True, 0, -1, 1.5))]
)
def test_what_is_no_run_is_refused(run: Any) -> None:
    with pytest.raises(FileError, match="no run of froude") as error:
        migrate(run, FILE)
    assert not isinstance(error.value, NewerError)


def test_what_is_whole_stays_as_it_is(written: dict[str, Any]) -> None:
    assert conform(written) == (written, ())
    assert conform(written | {"note": [1]})[0]["note"] == [1]  # keys beyond are kept


def test_keys_that_came_later_are_no_damage(written: dict[str, Any]) -> None:
    earlier = copy.deepcopy({key: value for key, value in written.items() if key != "twins"})
    for one in (earlier["scenario"], *earlier["flights"]):
        assert one.pop("faults") == []
    assert conform(earlier) == (written, ())


def test_what_cannot_be_is_left_out_or_replaced_and_told(written: dict[str, Any]) -> None:
    bad = copy.deepcopy(written)
    flight = bad["flights"][0]
    flight["gain_set"]["parameters"]["MC_ROLL_P"] = "many"
    flight["metrics"][0] = 7
    flight["outcome"] = "PERHAPS"
    flight["segments"][0]["start_s"] = None
    bad["flights"].append("a flight")
    del bad["vehicle"]
    whole, wrong = conform(bad)
    assert sorted(wrong) == [
        "flights[0].gain_set.parameters.MC_ROLL_P is 'many', not a number: left out",
        "flights[0].metrics[0] is 7, not an object: left out",
        "flights[0].outcome is 'PERHAPS', not PASS, FAIL, UNSET or INFO",
        "flights[0].segments[0].start_s is None, not a number",
        "flights[3] is 'a flight', not an object: left out",
        "vehicle is missing",
    ]
    assert whole["vehicle"] == nothing(RUN)["vehicle"]
    mended = whole["flights"][0]
    assert "MC_ROLL_P" not in mended["gain_set"]["parameters"]
    assert mended["outcome"] == "UNSET"
    assert mended["metrics"] == written["flights"][0]["metrics"][1:]
    assert whole["flights"][1] == written["flights"][1]
    assert len(whole["flights"]) == 3


def test_not_everything_wrong_is_told_one_by_one() -> None:
    _, wrong = conform({"schema_version": 2, "flights": [{}]})
    assert len(wrong) == MOST_TOLD + 1
    assert wrong[-1].endswith("more like these")


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from([*RUN, *FLIGHT, "x"]), inner, max_size=6)
    ),
    max_leaves=12,
)


@settings(deadline=None, max_examples=50)
@given(st.dictionaries(st.sampled_from([*RUN, "x"]), JSON))
def test_whatever_was_read_every_key_is_there_and_no_second_look_finds_more(run: dict[str, Any]) -> None:
    whole, _ = conform(run)
    assert set(RUN) <= set(whole)
    assert all(set(FLIGHT) <= set(flight) for flight in whole["flights"])
    again, wrong = conform(whole)
    assert wrong == ()
    assert repr(again) == repr(whole)  # nan is not nan, but looks the same
