"""The result as JUnit XML, for build servers.

One test suite per run. Each gain set has a case `verdict` and one for every limited metric. A limited metric
that could not be measured is a failure of type "unset", not a skip: a gate that never saw its number must not
turn green.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path

from scenarios.flight import FlightRecord, RunRecord
from scenarios.limits import Metric, Outcome
from scenarios.run_folder import write_atomically
from scenarios.table import assumption_lines, own_gains_line

_NOT_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 cannot hold; a vehicle's texts may."""


def write_junit(run: RunRecord, path: Path) -> Path:
    """Write the XML file.

    Raises:
        FileError: it cannot be written; what was there before is kept.
    """
    write_atomically(path, junit_xml(run))
    return path


def junit_xml(run: RunRecord) -> bytes:
    """The XML document; a case's `time` is the flight's length in vehicle time."""
    vehicle = str(run.vehicle.get("name") or run.scenario.vehicle)
    suite = ET.Element("testsuite", name=_text(f"{run.scenario.name} {vehicle} {run.scenario.profile}"))
    properties = ET.SubElement(suite, "properties")
    _property(properties, "scenario", run.scenario.name)
    _property(properties, "vehicle", vehicle)
    _property(properties, "profile", run.scenario.profile)
    _property(properties, "seed", run.scenario.seed)
    for name, version in run.versions.items():
        _property(properties, f"version.{name}", version)
    for flight in run.flights:
        for name, value in flight.gain_set.parameters.items():
            _property(properties, f"gains.{flight.gain_set.name}.{name}", value)
    for flight in run.flights:
        _cases(suite, flight, f"{run.scenario.name}.{vehicle}.{flight.gain_set.name}")
    cases = suite.findall("testcase")
    seconds = sum(_duration_s(flight) for flight in run.flights)
    suite.set("tests", str(len(cases)))
    suite.set("failures", str(sum(case.find("failure") is not None for case in cases)))
    suite.set("errors", "0")
    suite.set("skipped", "0")
    suite.set("time", f"{seconds:.3f}")
    if run.started_utc:
        # The schema's timestamps carry no zone.
        suite.set("timestamp", _text(run.started_utc.removesuffix("Z").partition("+")[0]))
    out = ET.SubElement(suite, "system-out")
    lines = [own_gains_line(run), *assumption_lines(run)]
    if not run.complete:
        lines.append("The run was interrupted.")
    out.text = _text("\n".join(line for line in lines if line))
    root = ET.Element("testsuites", {key: suite.attrib[key] for key in ("tests", "failures", "errors", "time")})
    root.append(suite)
    ET.indent(root)
    document: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return document + b"\n"


def _cases(suite: ET.Element, flight: FlightRecord, classname: str) -> None:
    attributes = {"classname": _text(classname)}
    verdict = ET.SubElement(suite, "testcase", attributes, name="verdict", time=f"{_duration_s(flight):.3f}")
    if flight.outcome in (Outcome.FAIL, Outcome.UNSET):
        _failure(verdict, flight.outcome, flight.reason or "no reason given")
    if flight.warnings:
        ET.SubElement(verdict, "system-out").text = _text("\n".join(flight.warnings))
    for metric in flight.metrics:
        if metric.limit is None or metric.segment:
            continue
        case = ET.SubElement(suite, "testcase", attributes, name=metric.name, time="0")
        if metric.outcome in (Outcome.FAIL, Outcome.UNSET):
            _failure(case, metric.outcome, _explain(metric))


def _explain(metric: Metric) -> str:
    if metric.value is None:
        return f"not measured: {metric.reason or 'no reason given'}; limit {metric.limit}"
    unit = "" if metric.unit == "1" else f" {metric.unit}"
    text = f"{metric.value:.4g}{unit}, limit {metric.limit}"
    return f"{text}; {metric.reason}" if metric.reason else text


def _failure(case: ET.Element, outcome: Outcome, message: str) -> None:
    failure = ET.SubElement(case, "failure", message=_text(message), type=outcome.value.lower())
    failure.text = _text(message)


def _property(properties: ET.Element, name: str, value: object) -> None:
    ET.SubElement(properties, "property", name=_text(name), value=_text(str(value)))


def _duration_s(flight: FlightRecord) -> float:
    time = flight.telemetry["t_s"]
    return float(time[-1] - time[0]) if len(time) else 0.0


def _text(text: str) -> str:
    return _NOT_XML.sub("?", text)
