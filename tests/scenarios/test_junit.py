import dataclasses
import xml.etree.ElementTree as ET

import pytest

from scenarios.junit import junit_xml, write_junit
from sitl.errors import FileError


@pytest.fixture
def suite(flown_run):
    return ET.fromstring(junit_xml(flown_run)).find("testsuite")


def cases(suite, gain_set):
    return {
        case.get("name"): case for case in suite.findall("testcase") if case.get("classname").endswith(f".{gain_set}")
    }


def test_a_case_for_the_verdict_and_each_limited_metric(suite):
    names = ["verdict", "oscillation_rad_s", "overshoot_pct", "rise_time_s", "delay_margin_s"]
    assert sorted(cases(suite, "own gains")) == sorted(names)
    assert sorted(cases(suite, "7.2 cycles")) == sorted(names)
    assert all(case.find("failure") is None for case in cases(suite, "own gains").values())


def test_failures_say_value_limit_and_reason(suite):
    failure = cases(suite, "7.2 cycles")["delay_margin_s"].find("failure")
    assert failure.get("type") == "fail"
    assert failure.get("message") == "0.0021 s, limit >= 0.01 s"
    assert "limit cycle on roll" in cases(suite, "7.2 cycles")["verdict"].find("failure").text


def test_what_was_not_measured_fails_a_limit(suite):
    failure = cases(suite, "7.2 cycles")["rise_time_s"].find("failure")
    assert failure.get("type") == "unset"
    assert failure.get("message") == "not measured: limit cycle; limit <= 0.4 s"


def test_counts_are_those_of_the_document(suite, flown_run):
    root = ET.fromstring(junit_xml(flown_run))
    found = suite.findall("testcase")
    assert int(suite.get("tests")) == len(found) == int(root.get("tests"))
    failed = [case for case in found if case.find("failure") is not None]
    assert int(suite.get("failures")) == len(failed) == int(root.get("failures"))
    assert float(suite.get("time")) == pytest.approx(2 * 12.0, abs=0.02)


def test_shape_of_the_common_schema(suite):
    """As Jenkins' junit-10.xsd: children in this order, attributes present, timestamp without a zone."""
    order = [child.tag for child in suite]
    assert order == ["properties", *["testcase"] * (len(order) - 2), "system-out"]
    assert suite.get("timestamp") == "2026-11-22T20:00:00"
    for case in suite.findall("testcase"):
        assert set(case.attrib) == {"classname", "name", "time"}
        assert {child.tag for child in case} <= {"failure", "system-out"}


def test_gains_and_circumstances_are_properties(suite):
    properties = {p.get("name"): p.get("value") for p in suite.find("properties")}
    assert properties["gains.7.2 cycles.MC_ROLLRATE_I"] == "35.8"
    assert properties["seed"] == "7"
    assert "own flight gains (own gains) fly" in suite.find("system-out").text


def test_text_that_xml_cannot_hold_does_not_break_the_document(suite):
    message = cases(suite, "refused")["verdict"].find("failure").get("message")
    assert message.startswith("arming refused: no gyro? <&>")


def test_written_whole_or_not_at_all(flown_run, tmp_path):
    path = write_junit(flown_run, tmp_path / "junit.xml")
    assert ET.parse(path).getroot().tag == "testsuites"
    with pytest.raises(FileError, match=r"junit\.xml.*cannot be written"):
        write_junit(flown_run, tmp_path / "nowhere" / "junit.xml")


def test_an_interrupted_run_is_still_a_document(flown_run):
    run = dataclasses.replace(flown_run, flights=(), complete=False)
    suite = ET.fromstring(junit_xml(run)).find("testsuite")
    assert suite.get("tests") == "0"
    assert "interrupted" in suite.find("system-out").text
