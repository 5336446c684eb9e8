"""Manoeuvres: the signals that are sent, the windows that are scored, the ones that are refused."""

from __future__ import annotations

import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from scenarios.manoeuvres import KINDS, make_manoeuvre, parse_manoeuvres
from sitl.errors import FileError

STEPS = Path(__file__).parents[1] / "data" / "px4-steps"
EXAMPLES: dict[str, dict[str, Any]] = {
    "step": {"amplitude_deg": 10.0},
    "doublet": {"amplitude_deg": 10.0, "hold_s": 3.0},
    "3211": {"amplitude_deg": 8.0, "unit_s": 0.4},
    "ramp": {"amplitude_deg": 15.0, "rate_deg_s": 10.0},
    "chirp": {"amplitude_deg": 5.0, "f0_hz": 0.2, "f1_hz": 5.0, "duration_s": 20.0},
    "multisine": {
        "peak_deg": 12.0,
        "frequencies_hz": [0.5, 1.1, 2.3],
        "phases_rad": [0.0, 1.0, 2.0],
        "duration_s": 10.0,
    },
    "track": {},
}


def test_every_kind_has_an_example() -> None:
    assert set(EXAMPLES) == set(KINDS)


def test_track_is_the_recorded_flights_set_points() -> None:
    import pyarrow.parquet as pq

    schema = pq.read_schema(STEPS / "ANT-X_track-flight_both_10.parquet")
    sent = json.loads(schema.metadata[b"froude"])["setpoint_deg"]
    track = make_manoeuvre("track")
    assert np.degrees(track.samples(50.0)[: len(sent)]) == pytest.approx(sent, abs=1e-5)
    assert not track.samples(50.0)[len(sent) :].any()
    window = track.windows[0]
    assert (window.kind, window.start_s, window.end_s) == ("track", 0.0, 20.0)
    assert math.degrees(window.phi_to_rad) == pytest.approx(15.0)


def test_doublet_is_the_recorded_flights_profile() -> None:
    doublet = make_manoeuvre("doublet", amplitude_deg=10.0, hold_s=3.0)
    assert doublet.duration_s == 12.0
    expected = np.repeat([10.0, 0.0, -10.0, 0.0], 150)
    assert np.degrees(doublet.samples(50.0)) == pytest.approx(expected)
    assert [window.kind for window in doublet.windows] == ["step", "hold", "hold", "hold"]


@pytest.mark.parametrize("kind", sorted(KINDS))
@pytest.mark.parametrize("rate_hz", [50.0, 100.0, 250.0])
def test_windows_cover_the_manoeuvre_and_it_ends_level(kind: str, rate_hz: float) -> None:
    manoeuvre = make_manoeuvre(kind, setpoint_rate_hz=rate_hz, **EXAMPLES[kind])
    edges = [window.start_s for window in manoeuvre.windows] + [manoeuvre.windows[-1].end_s]
    assert edges[0] == 0.0
    assert edges[-1] == pytest.approx(manoeuvre.duration_s)
    assert all(a < b for a, b in pairwise(edges))
    for edge in edges:
        assert edge * rate_hz == pytest.approx(round(edge * rate_hz), abs=1e-6)
    samples = manoeuvre.samples(rate_hz)
    assert len(samples) == round(manoeuvre.duration_s * rate_hz)
    assert samples[-1] == 0.0
    assert manoeuvre.setpoint(-0.001) == manoeuvre.setpoint(manoeuvre.duration_s) == 0.0
    assert np.abs(samples).max() <= math.radians(45.0)
    at = len(samples) // 3
    assert manoeuvre.setpoint(at / rate_hz) == samples[at]
    json.dumps(manoeuvre.settings)


def test_step_windows_carry_the_set_points() -> None:
    up, back = make_manoeuvre("step", amplitude_deg=-12.0, hold_s=2.0, return_s=4.0).windows
    assert (up.kind, up.start_s, up.end_s) == ("step", 0.0, 2.0)
    assert (up.phi_from_rad, math.degrees(up.phi_to_rad)) == (0.0, pytest.approx(-12.0))
    assert (back.kind, back.start_s, back.end_s, back.phi_to_rad) == ("hold", 2.0, 6.0, 0.0)
    assert back.phi_from_rad == up.phi_to_rad


def test_3211_pattern() -> None:
    samples = np.degrees(make_manoeuvre("3211", amplitude_deg=8.0, unit_s=0.4, return_s=0.0).samples(50.0))
    assert samples == pytest.approx(np.repeat([8, 8, 8, -8, -8, 8, -8], 20))


def test_ramp_has_the_rate_asked_for() -> None:
    ramp = make_manoeuvre("ramp", amplitude_deg=15.0, rate_deg_s=10.0, hold_s=1.0)
    samples = np.degrees(ramp.samples(50.0))
    assert set(np.round(np.abs(np.diff(samples)), 9)) == {0.0, 0.2}
    assert (samples.max(), samples.min()) == (pytest.approx(15.0), pytest.approx(-15.0))


@pytest.mark.parametrize("sweep", ["log", "linear"])
def test_chirp_sweeps_between_its_frequencies(sweep: str) -> None:
    chirp = make_manoeuvre(
        "chirp", amplitude_deg=5, f0_hz=0.5, f1_hz=4.0, duration_s=20, sweep=sweep, fade_s=0, return_s=0
    )
    phi = chirp.samples(1000.0)
    ups = np.flatnonzero((phi[:-1] < 0) & (phi[1:] >= 0)) / 1000.0
    middle = (ups[:-1] + ups[1:]) / 2 / 20.0
    expected = 0.5 * 8.0**middle if sweep == "log" else 0.5 + 3.5 * middle
    assert len(middle) > 30
    assert 1 / np.diff(ups) == pytest.approx(expected, rel=0.02)


def test_multisine_has_its_peak_and_frequencies() -> None:
    phi = np.degrees(make_manoeuvre("multisine", **(EXAMPLES["multisine"] | {"fade_s": 0.0})).samples(50.0))[:500]
    assert np.abs(phi).max() == pytest.approx(12.0)
    power = np.abs(np.fft.rfft(phi))
    assert sorted(np.argsort(power)[-3:] * 0.1) == pytest.approx([0.5, 1.1, 2.3])


@pytest.mark.parametrize(
    ("kind", "keys", "text"),
    [
        ("step", {"amplitude_deg": 400}, "amplitude_deg: 400 is out of range. It must be <= 45"),
        ("step", {"amplitude_deg": -46}, "It must be >= -45"),
        ("step", {"amplitude_deg": 0}, "0 moves nothing"),
        ("step", {"amplitude_deg": float("nan")}, "not finite"),
        ("step", {"amplitude_deg": "10"}, "not a number"),
        ("step", {"amplitude_deg": True}, "not a number"),
        ("step", {}, "amplitude_deg: missing key"),
        ("step", {"amplitude_rad": 0.1}, 'the file has "amplitude_rad"'),
        ("step", {"amplitude_deg": 5, "hold": 2}, 'did you mean "hold_s"?'),
        ("step", {"amplitude_deg": 5, "hold_s": 0}, "hold_s: 0 is out of range"),
        ("step", {"amplitude_deg": 5, "hold_s": 601}, "It must be <= 600"),
        ("step", {"amplitude_deg": 5, "hold_s": 1.01}, "1.01 s falls between two set-points"),
        ("step", {"amplitude_deg": 5, "return_s": -1}, "return_s: -1 is out of range"),
        ("doublet", {"amplitude_deg": 5, "hold_s": 200}, "800 s in all"),
        ("steps", {"amplitude_deg": 5}, 'did you mean "step"?'),
        ("chirp", EXAMPLES["chirp"] | {"f1_hz": 25.0}, "f1_hz: 25 is out of range. It must be < 25"),
        ("chirp", EXAMPLES["chirp"] | {"f0_hz": 0.0}, "f0_hz: 0 is out of range"),
        ("chirp", EXAMPLES["chirp"] | {"sweep": "cubic"}, 'Write "log" or "linear"'),
        ("chirp", EXAMPLES["chirp"] | {"fade_s": 11.0}, "fade_s: 11 is out of range"),
        ("multisine", EXAMPLES["multisine"] | {"frequencies_hz": [1, 2, 30]}, "30 is out of range"),
        ("multisine", EXAMPLES["multisine"] | {"frequencies_hz": [1, 1, 2]}, "given twice"),
        ("multisine", EXAMPLES["multisine"] | {"phases_rad": [0]}, "not a list of 3 numbers"),
        ("multisine", EXAMPLES["multisine"] | {"frequencies_hz": []}, "not a list"),
        ("ramp", {"amplitude_deg": 10, "rate_deg_s": 0}, "rate_deg_s: 0 is out of range"),
        ("ramp", {"amplitude_deg": 10, "rate_deg_s": 7}, "falls between two set-points"),
        ("track", {"amplitude_deg": 10}, "amplitude_deg: unknown key"),
    ],
)
def test_bad_manoeuvres_name_key_value_and_remedy(kind: str, keys: dict[str, Any], text: str) -> None:
    with pytest.raises(FileError) as error:
        make_manoeuvre(kind, **keys)
    assert text in str(error.value)


@pytest.mark.parametrize(
    ("tables", "text"),
    [
        (None, "holds no [[manoeuvre]]"),
        ([], "holds no [[manoeuvre]]"),
        ([{"amplitude_deg": 1}], "manoeuvre[0].kind: missing key"),
        ([{"kind": "track"}, {"kind": "track"}], 'manoeuvre[1].name: "track" is used twice'),
        ([{"kind": "track"}, {"kind": "step", "amplitude_deg": 50}], "manoeuvre[1].amplitude_deg: 50"),
        (
            [{"kind": "step", "name": f"{n}", "amplitude_deg": 5, "hold_s": 300} for n in range(2)],
            "606 s together",
        ),
    ],
)
def test_bad_lists_of_manoeuvres(tables: Any, text: str) -> None:
    with pytest.raises(FileError) as error:
        parse_manoeuvres(tables, Path("my.toml"), 50.0)
    assert str(error.value).startswith("my.toml: ")
    assert text in str(error.value)


@example({"amplitude_deg": 1.0, "hold_s": 6e-220, "return_s": 0.0})
@given(st.dictionaries(st.sampled_from(["amplitude_deg", "hold_s", "return_s", "x"]), st.floats() | st.text()))
def test_any_keys_make_a_safe_manoeuvre_or_a_file_error(keys: dict[str, Any]) -> None:
    try:
        manoeuvre = make_manoeuvre("step", **keys)
    except FileError:
        return
    samples = manoeuvre.samples(50.0)
    assert np.isfinite(samples).all()
    assert np.abs(samples).max() <= math.radians(45.0)
    assert 0 < manoeuvre.duration_s <= 600
