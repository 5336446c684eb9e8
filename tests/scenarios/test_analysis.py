"""`froude analyse`: what it counts, what it says matters most, and what it says when something is wrong."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.stats

from scenarios.analysis import Analysis, analyse, manoeuvres, spread, wilson
from scenarios.analysis_text import analysis_object, analysis_text
from scenarios.cli import main
from scenarios.gain_set import GainSet, load_all
from scenarios.limits import LIMIT_SETS
from scenarios.monte_carlo import monte_carlo
from scenarios.roll_set import roll_set
from sitl.airframe import DERIVATIVE_NAMES, Derivatives, load_airframe
from sitl.profile import get_profile
from sitl.vehicle_spec import VehicleModel, resolve_vehicle

AIRFRAMES = Path(load_airframe("ant-x").path).parent
REFS = ("table_2_2/ANT-X", "table_7_2/ANT-X", "table_7_2/ADAM-0")


def made(model: VehicleModel | None = None, refs: tuple[str, ...] = REFS, **changes: object) -> Analysis:
    model = model or resolve_vehicle("ant-x")
    profile = get_profile("sitl")
    sets = [(one, roll_set(model, profile, one.parameters)) for one in load_all(refs)]
    return analyse(model, profile, sets, **({"samples": 120, "seed": 5} | changes))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def analysis() -> Analysis:
    return made()


Froude = Callable[..., tuple[int, str, str]]


@pytest.fixture
def froude(capsys: pytest.CaptureFixture[str]) -> Froude:
    def run(*words: object) -> tuple[int, str, str]:
        capsys.readouterr()
        status = main([str(word) for word in words])
        out, err = capsys.readouterr()
        return status, out, err

    return run


@pytest.mark.parametrize(("passes", "of"), [(0, 1), (1, 1), (0, 500), (500, 500), (3, 500), (250, 500), (17, 23)])
def test_the_interval_is_wilsons(passes: int, of: int) -> None:
    low, high = wilson(passes, of)
    wanted = scipy.stats.binomtest(passes, of).proportion_ci(0.95, method="wilson")
    assert (low, high) == pytest.approx((wanted.low, wanted.high), abs=1e-9)


def test_worst_is_worst_for_the_metric() -> None:
    row = np.array([5.0, 1.0, math.nan, 9.0, 3.0])
    assert dataclasses.astuple(spread("overshoot_pct", row)) == (5.0, 9.0, 3.0, 1.0, 1)
    assert dataclasses.astuple(spread("vaf_pct", row)) == (5.0, 1.0, 3.0, 9.0, 1)
    assert dataclasses.astuple(spread("droop_deg", np.array([0.0, -4.0, 1.0]))) == (0.0, -4.0, -1.5, 1.0, 0)
    assert dataclasses.astuple(spread("lag_s", np.full(3, math.nan))) == (None, None, None, None, 2)
    assert dataclasses.astuple(spread("lag_s", np.array([2.0]))) == (2.0, 2.0, 2.0, 2.0, 0)


def test_what_passes_is_counted_sample_by_sample(analysis: Analysis) -> None:
    """Counted again from the Monte Carlo, limit by limit."""
    model, profile = resolve_vehicle("ant-x"), get_profile("sitl")
    sets = {one.name: roll_set(model, profile, one.parameters) for one in load_all(REFS)}
    found = monte_carlo(model, sets, profile, manoeuvres(), samples=120, seed=5)
    assert found.margins is not None
    limits = {limit.metric: limit for limit in LIMIT_SETS["practical"]}
    assert set(limits) == {"oscillation_rad_s", "overshoot_pct", "rise_time_s", "delay_margin_s"}
    for g, one in enumerate(analysis.sets):
        good = (
            (found.metrics["oscillation_rad_s"][g, 1:] <= 0.3)
            & (found.metrics["overshoot_pct"][g, 1:] <= 10.0)
            & (found.metrics["rise_time_s"][g, 1:] <= 0.4)
            & (found.margins.delay_margin_s[g, 1:] >= 0.01)
        )
        assert (one.passes, one.of) == (int(good.sum()), 120)
        assert one.unstable == int((~found.margins.closed_loop_stable[g, 1:]).sum())
        delay = found.margins.delay_margin_s[g]
        assert one.spreads["delay_margin_s"].worst == pytest.approx(float(np.nanmin(delay[1:])))
        assert one.spreads["delay_margin_s"].nominal == pytest.approx(float(delay[0]))
    flown, cycling, near = analysis.sets
    assert (flown.passes, flown.nominal_passes, flown.unstable, flown.cycling) == (120, True, 0, 0)
    assert (cycling.passes, cycling.unstable, cycling.cycling) == (0, 120, 120)
    assert (near.passes, near.unstable) == (0, 0)


@pytest.mark.parametrize("name", ["Ld", "Lp"])
def test_what_alone_varies_matters_alone(name: str) -> None:
    model = resolve_vehicle("ant-x")
    only = {one: (10.0 if one == name else 0.0) for one in DERIVATIVE_NAMES}
    model = dataclasses.replace(model, sigma_pct=Derivatives(**only))
    (one,) = made(model, REFS[:1]).sets
    by_name = {s.metric: s for s in one.sensitivities}
    assert set(by_name["delay_margin_s"].shares) == {name}
    assert by_name["delay_margin_s"].shares[name] > 0.95


def test_the_change_per_sigma_is_that_of_the_margin() -> None:
    """Delay margin of ANT-X with Ld one sigma up and down, the others as they are."""
    from sitl.sampled_loop import RollGains
    from sitl.stability import loop_margins

    model = resolve_vehicle("ant-x")
    (one,) = made(refs=REFS[:1], samples=500).sets
    shown = {s.metric: s for s in one.sensitivities}["delay_margin_s"].per_sigma["Ld"]
    gains, profile = RollGains(6.5, 1.0, 0.05, 0.05, 0.001), get_profile("sitl")
    sigma = model.derivatives.Ld * model.sigma_pct.Ld / 100.0
    up, down = (
        loop_margins(
            dataclasses.replace(model.derivatives, Ld=model.derivatives.Ld + side * sigma), gains, profile, 0.025
        ).delay_margin_s
        for side in (1.0, -1.0)
    )
    assert up is not None
    assert down is not None
    assert shown == pytest.approx((up - down) / 2.0, rel=0.05)


def test_an_airframe_without_sigma_is_said_to_have_none() -> None:
    model = dataclasses.replace(resolve_vehicle("ant-x"), sigma_pct=Derivatives(*[0.0] * 6))
    alone = made(model, REFS[:1])
    assert alone.samples == 0
    assert alone.sets[0].of == 1
    assert alone.sets[0].nominal_passes
    assert "it states no uncertainty, nothing to vary" in analysis_text(alone)


def test_text_and_object_say_the_same(analysis: Analysis) -> None:
    shown = json.loads(json.dumps(analysis_object(analysis), allow_nan=False))
    text = analysis_text(analysis)
    for one in shown["gain_sets"]:
        assert f"{one['name']}: passes {one['passes']} of {one['of']}" in text
        assert one["pass_fraction"] == one["passes"] / one["of"]
    assert shown["gain_sets"][0]["metrics"]["delay_margin_s"]["unit"] == "s"
    assert shown["gain_sets"][1]["metrics"]["overshoot_pct"]["worst"] is None


class TestCommand:
    def test_one_line_says_what_was_looked_at(self, froude: Froude) -> None:
        status, out, _ = froude("analyse", "--gains", "table_2_2/ANT-X", "--samples", 30, "--seed", 9)
        assert status == 0
        assert "profile sitl: the nominal model and 30 samples (gaussian, within 3 sigma, seed 9)" in out
        assert "passes 30 of 30 (100.0 %, 95 % interval 88.6 to 100.0 %)" in out

    def test_json_is_json_and_repeats(self, froude: Froude) -> None:
        words = ("analyse", "--samples", 20, "--json", "--profile", "study", "--distribution", "uniform")
        first, second = froude(*words), froude(*words)
        assert first == second
        assert json.loads(first[1])["distribution"] == "uniform"
        assert not re.search(r"\bNaN\b|Infinity", first[1])

    @pytest.mark.parametrize(
        ("words", "said"),
        [
            (["--samples", 0], "--samples 0: give 1 or more"),
            (["--samples", -3], "--samples -3"),
            (["--samples", 10**9], "samples = 1000000000: give 0 to 1000000"),
            (["--limits", "pratical"], 'did you mean "practical"'),
            (["--gains", "tabel_2_2"], "tabel_2_2"),
            (["--gains", "table_2_2/ANT-Y"], "ANT-Y"),
            (["--seed", -1], "--seed -1: give 0 or more"),
            (["--spread", 0], "spread_sigma = 0"),
            (["--spread", -2], "spread_sigma = -2"),
            (["--spread", "nan"], "spread_sigma = nan"),
            (["--spread", 100], "spread_sigma = 100"),
            (["--vehicle", "ant-y"], 'unknown airframe "ant-y"'),
            (["--vehicle", "ant-r:ant-x", "--scaling", "sizes"], "sizes"),
        ],
        ids=lambda value: " ".join(map(str, value)) if isinstance(value, list) else "",
    )
    def test_what_cannot_be_analysed(self, froude: Froude, words: list[object], said: str) -> None:
        status, out, err = froude("analyse", *words)
        assert (status, out) == (2, "")
        assert said in err
        assert err.count("\n") == 1
        assert err.startswith("froude: ")

    @pytest.mark.parametrize(
        ("line", "said"),
        [
            ("diagonal_m = 0.0", "diagonal_m"),
            ("diagonal_m = -0.16", "diagonal_m"),
            ("diagonal_m = nan", "diagonal_m"),
            ("lateral_m = -1", "lateral_m"),
            ("mass_kg = 0", "mass_kg"),
        ],
    )
    def test_lengths_that_are_none(self, froude: Froude, tmp_path: Path, line: str, said: str) -> None:
        key = line.split()[0]
        text = re.sub(rf"(?m)^{key} = .*$", line, (AIRFRAMES / "ant-x.toml").read_text())
        (tmp_path / "odd.toml").write_text(text)
        status, _, err = froude("analyse", "--vehicle", tmp_path / "odd.toml")
        assert status == 2
        assert said in err

    @pytest.mark.parametrize("diagonal", ["1.6e5", "1.6e-7"], ids=["N of 1e-6", "N of 1e6"])
    def test_a_froude_number_beyond_all_sense(self, froude: Froude, tmp_path: Path, diagonal: str) -> None:
        """A speck or a town of an aircraft: it says what such a model does, or that it cannot be had."""
        text = (AIRFRAMES / "ant-x.toml").read_text().replace("diagonal_m = 0.16 ", f"diagonal_m = {diagonal} ")
        (tmp_path / "odd.toml").write_text(text)
        for spec in (f"ant-x:{tmp_path / 'odd.toml'}", f"{tmp_path / 'odd.toml'}:ant-x"):
            status, out, err = froude(
                "analyse", "--vehicle", spec, "--scaling", "derivatives,uncertainty,gain", "--samples", 20,
                "--gains", "table_2_2/ANT-X",
            )  # fmt: skip
            assert "Traceback" not in err
            assert (status == 0 and "passes 0 of" in out) or (status == 2 and err.count("\n") == 1)

    def test_sigma_above_a_hundred_per_cent(self, froude: Froude, tmp_path: Path) -> None:
        """Some samples have no roll authority, or the wrong way round: they are lost, counted and said."""
        text = (AIRFRAMES / "ant-x.toml").read_text().replace("Ld_pct = 0.81", "Ld_pct = 150.0")
        (tmp_path / "unsure.toml").write_text(text)
        status, out, _ = froude(
            "analyse", "--vehicle", tmp_path / "unsure.toml", "--gains", "table_2_2/ANT-X", "--samples", 200
        )
        assert status == 0
        lost = int(re.search(r"(\d+) lost", out)[1])  # type: ignore[index]
        unstable = int(re.search(r"(\d+) unstable", out)[1])  # type: ignore[index]
        # P(Ld < 0) of a Gaussian with sigma 1.5, cut at 3 sigma: about a quarter
        assert 30 < lost <= unstable < 100

    def test_gains_of_zero(self, froude: Froude, tmp_path: Path) -> None:
        names = ("MC_ROLL_P", "MC_ROLLRATE_P", "MC_ROLLRATE_I", "MC_ROLLRATE_D", "MC_ROLLRATE_K")
        lines = "\n".join(f"{name} = 0.0" for name in names)
        (tmp_path / "none.toml").write_text(f'[[gain_set]]\nname = "none"\n[gain_set.parameters]\n{lines}\n')
        status, out, err = froude("analyse", "--gains", tmp_path / "none.toml", "--samples", 10)
        assert status == 0 or (status == 2 and "MC_ROLLRATE_K" in err)
        if status == 0:
            assert "passes 0 of 10" in out
            assert "10 unstable" in out


def test_a_gain_set_of_filters_and_gains_flies_its_filters() -> None:
    """A gyro filter of 15 Hz costs delay margin: the analysis knows it."""
    base = {"MC_ROLL_P": 6.5, "MC_ROLLRATE_P": 0.05, "MC_ROLLRATE_I": 0.05, "MC_ROLLRATE_D": 0.001}
    model, profile = resolve_vehicle("ant-x"), get_profile("sitl")
    sets = [
        (GainSet(name, values, "", ""), roll_set(model, profile, values))
        for name, values in (("usual", base), ("slow", base | {"IMU_GYRO_CUTOFF": 15.0}))
    ]
    usual, slow = analyse(model, profile, sets, samples=20).sets
    worst = [one.spreads["delay_margin_s"].worst for one in (usual, slow)]
    assert worst[0] is not None
    assert worst[1] is not None
    # a second-order Butterworth at 15 Hz instead of 40 delays by sqrt(2) / (2 pi) (1/15 - 1/40) s more
    assert worst[0] - worst[1] == pytest.approx(math.sqrt(2.0) / (2.0 * math.pi) * (1 / 15 - 1 / 40), abs=0.004)
