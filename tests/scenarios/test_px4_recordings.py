"""The whole chain, MAVLink included, against nine recorded flights of a real PX4 on the study's plant."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from scenarios.gain_set import GainSet, load_gain_sets
from scenarios.metrics import dominant_frequency
from scenarios.one_flight import fly
from scenarios.runner import plan
from scenarios.scenario import load_scenario
from sitl.airframe import Rotor

RECORDINGS = sorted((Path(__file__).parents[1] / "data" / "px4-steps").glob("*.parquet"))
SQUARE = tuple(Rotor(x, y, 0.0, km) for x, y, km in ((1, 1, 0.05), (-1, -1, 0.05), (1, -1, -0.05), (-1, 1, -0.05)))
PARAMETERS = {"K_phi": "MC_ROLL_P", "K_P": "MC_ROLLRATE_P", "K_I": "MC_ROLLRATE_I", "K_D": "MC_ROLLRATE_D"}


def recorded(path):
    table = pq.read_table(path)
    about = json.loads(table.schema.metadata[b"froude"])
    return about, {name: table[name].to_numpy() for name in table.column_names}


def flown(about):
    """Our flight of the same case: same airframe, rotors, gains, axes and motor lag."""
    scenario = load_scenario("tracking" if "track" in about["case"] else "doublet")
    scenario = dataclasses.replace(
        scenario,
        vehicle=about["frame"].lower(),
        axes=about["axes"],
        overrides={"motor_lag_s": about["motor_lag_s"]},
        gate=dataclasses.replace(scenario.gate, timeout_s=6.0),
    )
    model = scenario.resolve_vehicle()
    rotors = tuple(Rotor(r["px"], r["py"], 0.0, r["km"]) for r in about.get("rotors", ())) or SQUARE
    model = dataclasses.replace(model, airframe=dataclasses.replace(model.airframe, rotors=rotors))
    if about["gains"] is None:
        (gain_set,) = load_gain_sets("px4_defaults")
    else:
        gain_set = GainSet("recorded", {PARAMETERS[key]: value for key, value in about["gains"].items()})
    record = fly(plan(gain_set, scenario, model, scenario.resolve_profile()))
    start_s = record.segments[0].start_s
    telemetry = record.telemetry.between(start_s - 0.5, start_s + 25.0)
    return record, telemetry["t_s"] - start_s, telemetry


def third_second(t_s, rate):
    rows = (t_s >= 2.0) & (t_s < 3.0)
    return t_s[rows], np.asarray(rate[rows], dtype=float)


@pytest.mark.parametrize("path", RECORDINGS, ids=[path.stem for path in RECORDINGS])
def test_flies_as_the_real_px4_did(path):
    about, real = recorded(path)
    record, t_s, ours = flown(about)
    _, real_p = third_second(real["t_s"], real["p_rad_s"])
    t3_s, our_p = third_second(t_s, ours["p_rad_s"])
    real_q = third_second(real["t_s"], real["q_rad_s"])[1].std()
    our_q = third_second(t_s, ours["q_rad_s"])[1].std()
    tracking = "track" in about["case"]
    if not tracking:
        assert (our_p.std() > 0.3, our_q > 0.3) == (real_p.std() > 0.3, real_q > 0.3)
    if not tracking and real_p.std() > 0.3:
        rows = (real["t_s"] >= 2.0) & (real["t_s"] < 3.0)
        real_hz = dominant_frequency(real["t_s"][rows], real_p)
        assert dominant_frequency(t3_s, our_p) == pytest.approx(real_hz, abs=0.2)
        assert our_p.std() == pytest.approx(real_p.std(), rel=0.05)
        assert str(record.outcome) == "FAIL"
        assert "limit cycle" in record.reason
        return
    end_s = 20.0 if tracking else 12.0
    grid = real["t_s"][(real["t_s"] >= 0.0) & (real["t_s"] < end_s)]
    difference = np.interp(grid, t_s, ours["phi_rad"]) - np.interp(grid, real["t_s"], real["phi_rad"])
    assert math.degrees(math.sqrt(np.mean(difference**2))) < 0.2


def test_there_are_nine():
    assert len(RECORDINGS) == 9


# Further flights of the same PX4 of which only these figures were kept: standard deviation of the rate in the third
# second and its frequency. Motor lag 10 ms unless the profile says otherwise.
FIGURES = {
    "defaults shake ANT-R in pitch": ("ant-r", "px4_defaults", "both", {"motor_lag_s": 0.0}, SQUARE, "q", 3.294, 35.6),
    "H frame": ("ant-r", "px4_defaults", "both", {}, None, "q", 3.297, 21.2),
    "one more tick": ("ant-r", "table_2_2/ANT-R", "both", {"transport_delay_ticks": 1}, SQUARE, "q", 4.5, 16.4),
    "two more ticks": ("ant-r", "table_2_2/ANT-R", "both", {"transport_delay_ticks": 2}, SQUARE, "q", 6.1, 13.5),
    "five more ticks": ("ant-r", "table_2_2/ANT-R", "both", {"transport_delay_ticks": 5}, SQUARE, "q", 10.5, 8.8),
    "eight rotors": ("carrier-1", "table_7_3/ADAM-0", "roll", {}, None, "p", 0.92, 13.9),
    "four rotors": ("carrier-1", "table_7_3/ADAM-0", "roll", {}, SQUARE, "p", 1.20, 13.9),
    "no lag": ("ant-x", "table_7_2/ANT-X", "roll", {"motor_lag_s": 0.0}, SQUARE, "p", 1.66, 26.6),
}


@pytest.mark.parametrize("case", FIGURES.values(), ids=FIGURES)
def test_limit_cycles_are_those_of_the_real_px4(case):
    vehicle, gains, axes, overrides, rotors, rate, amplitude_rad_s, hertz = case
    scenario = load_scenario("doublet")
    scenario = dataclasses.replace(
        scenario,
        vehicle=vehicle,
        axes=axes,
        overrides={"motor_lag_s": 0.010, **overrides},
        gate=dataclasses.replace(scenario.gate, timeout_s=6.0),
    )
    model = scenario.resolve_vehicle()
    if rotors is not None:
        model = dataclasses.replace(model, airframe=dataclasses.replace(model.airframe, rotors=rotors))
    (gain_set,) = load_gain_sets(gains)
    record = fly(plan(gain_set, scenario, model, scenario.resolve_profile()))
    start_s = record.segments[0].start_s
    telemetry = record.telemetry
    t_s, values = third_second(telemetry["t_s"] - start_s, telemetry[f"{rate}_rad_s"])
    assert values.std() == pytest.approx(amplitude_rad_s, rel=0.05)
    assert dominant_frequency(t_s, values) == pytest.approx(hertz, abs=0.2)
    assert "limit cycle" in record.reason
