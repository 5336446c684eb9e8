"""Derivatives from a multisine: beside a simulation that shares nothing with ours, and from flight to airframe file."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.signal

from scenarios.cli import main
from scenarios.flight import Segment
from scenarios.identification.flight_data import Excitation, LateralResponse, excitation_of, responses
from scenarios.identification.frequency_response import period_of, response, spectra
from scenarios.identification.lateral_fit import fit, model
from scenarios.run_folder import load_run
from scenarios.telemetry import Telemetry
from sitl.airframe import DERIVATIVE_NAMES, Derivatives, load_airframe
from sitl.errors import FileError, UsageError

G = 9.81  # the study
RATE_HZ = 200.0
FREQUENCIES = np.array([0.1, 0.2, 0.3, 0.5, 0.7, 0.9, 1.1, 1.4, 1.8, 2.3, 2.9, 3.7, 4.7, 5.9, 7.3])
LAG_S, START_S, LENGTH_S = 0.03, 5.0, 64.0
TRUTHS = {
    "small": Derivatives(-0.11, 0.12, -10.2, -6.0, -2.6, 450.0),
    "large": Derivatives(-0.6, -0.2, 10.8, -5.2, -0.5, 187.0),
}
LIBRARY = Path(__file__).parents[2] / "scenarios" / "library"


def simulated(truth: Derivatives, seed: int, noise: float = 1.0, length_s: float = LENGTH_S) -> dict[str, np.ndarray]:
    """A linear roll loop flown by `scipy.signal.lsim`: exact in continuous time, small angles, with sensor noise."""
    Yv, Yp, Yd, Lv, Lp, Ld = truth.as_array()
    # v, p, phi, motors
    a = np.array([[Yv, Yp, G, Yd], [Lv, Lp, 0.0, Ld], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, -1.0 / LAG_S]])
    b = np.array([[0.0], [0.0], [0.0], [1.0 / LAG_S]])
    # command = g (6 (phi_sp - phi) - p), a loop that holds either aircraft
    gain = 12.0 / Ld
    feedback = np.array([[0.0, gain, 6.0 * gain, 0.0]])
    t = np.arange(0.0, START_S + length_s + 2.0, 1.0 / RATE_HZ)
    phases = np.random.default_rng(7).uniform(0.0, 2.0 * np.pi, len(FREQUENCIES))
    local = t - START_S
    wanted = np.sin(2.0 * np.pi * np.multiply.outer(local, FREQUENCIES) + phases).sum(axis=1)
    wanted *= np.radians(2.0) * np.clip(np.minimum(local, length_s - local), 0.0, 1.0)
    rng = np.random.default_rng(seed)
    # what the loop hears is noisy, and acts on it
    heard = noise * rng.normal(0.0, 0.02, (len(t), 1))
    system = scipy.signal.StateSpace(
        a - b @ feedback, np.hstack([b * 6.0 * gain, -b * gain]), np.eye(4), np.zeros((4, 2))
    )
    _, _, x = scipy.signal.lsim(system, np.column_stack([wanted, heard[:, 0]]), t)
    v, p, phi, _ = x.T
    command = gain * (6.0 * (wanted - phi) - p - heard[:, 0])
    return {
        "t_s": t,
        "phi_rad": phi,
        "theta_rad": np.zeros_like(t),
        "psi_rad": np.zeros_like(t),
        "p_rad_s": p + noise * rng.normal(0.0, 0.003, len(t)),
        "q_rad_s": np.zeros_like(t),
        "r_rad_s": np.zeros_like(t),
        "phi_sp_rad": wanted,
        "v_north_m_s": np.zeros_like(t),
        # level heading north: right is east, turned by the roll angle
        "v_east_m_s": (v + noise * rng.normal(0.0, 0.02, len(t))) * np.cos(phi),
        "v_down_m_s": v * np.sin(phi),
        **{f"motor{n}": np.full_like(t, 0.5) for n in range(1, 5)},
        "delta_lat": command,
    }


def identified(columns: dict[str, np.ndarray], length_s: float = LENGTH_S) -> tuple[LateralResponse, Any]:
    excitation = Excitation(START_S, START_S + length_s, FREQUENCIES)
    measured = responses(Telemetry.from_columns(columns), excitation)
    # phi is small and linear here: gravity acts on the angle itself
    return measured, fit(measured.roll, measured.speed, gravity_m_s2=G)


class TestFrequencyResponse:
    def test_a_period_is_the_common_one(self) -> None:
        assert period_of(np.array([0.1, 0.3, 7.3])) == pytest.approx(10.0)
        assert period_of(np.array([0.25, 1.5])) == pytest.approx(4.0)
        with pytest.raises(UsageError, match=r"0\.01 Hz"):
            period_of(np.array([0.1, math.pi]))
        with pytest.raises(UsageError, match=r"0\.01 Hz"):
            period_of(np.array([0.001]))

    def test_amplitude_and_phase_of_a_sine_on_uneven_samples(self) -> None:
        rng = np.random.default_rng(3)
        t = np.sort(rng.uniform(0.0, 32.0, 20_000))
        omega = 2.0 * np.pi * np.array([0.5, 1.5])
        signal = 0.7 * np.cos(omega[0] * t + 0.4) + 0.2 * np.cos(omega[1] * t - 1.0) + 5.0
        found = spectra(t, signal, 1.0, 2.0, 15, omega)
        wanted = np.array([0.7 * np.exp(1j * (omega[0] + 0.4)), 0.2 * np.exp(1j * (omega[1] - 1.0))])
        assert found == pytest.approx(np.broadcast_to(wanted, found.shape), abs=2e-3)

    def test_a_delay_is_only_a_phase(self) -> None:
        t = np.arange(0.0, 50.0, 0.005)
        omega = 2.0 * np.pi * FREQUENCIES
        late = 0.04
        u = sum(np.sin(w * t) for w in omega)
        y = sum(np.sin(w * (t - late)) for w in omega)
        made = [spectra(t, one, 5.0, 10.0, 4, omega) for one in (u, y)]
        found = response(made[0], made[1], omega)
        assert found.value == pytest.approx(np.exp(-1j * omega * late), abs=1e-6)
        assert found.coherence == pytest.approx(1.0)
        assert found.deviation.max() < 1e-6

    def test_the_deviation_is_the_scatter_that_comes_out(self) -> None:
        """Of many flights with noise, the responses scatter as each of them says."""
        omega = 2.0 * np.pi * FREQUENCIES
        t = np.arange(0.0, 60.0, 0.01)
        u = sum(np.sin(w * t) for w in omega)
        values, deviations = [], []
        for seed in range(60):
            y = 2.0 * u + np.random.default_rng(seed).normal(0.0, 3.0, len(t))
            made = [spectra(t, one, 0.0, 10.0, 6, omega) for one in (u, y)]
            found = response(made[0], made[1], omega)
            values.append(found.value)
            deviations.append(found.deviation)
        scatter = np.sqrt((np.abs(np.array(values) - 2.0) ** 2).mean(axis=0))
        assert np.sqrt((np.array(deviations) ** 2).mean(axis=0)) == pytest.approx(scatter, rel=0.25)

    def test_noise_lowers_coherence(self) -> None:
        omega = 2.0 * np.pi * FREQUENCIES
        t = np.arange(0.0, 60.0, 0.01)
        u = sum(np.sin(w * t) for w in omega)
        y = np.random.default_rng(1).normal(0.0, 3.0, len(t))
        made = [spectra(t, one, 0.0, 10.0, 6, omega) for one in (u, y)]
        assert response(made[0], made[1], omega).coherence.mean() < 0.5

    def test_three_periods_at_least(self) -> None:
        two = np.ones((2, 3), dtype=complex)
        with pytest.raises(UsageError, match="only 2 whole periods"):
            response(two, two, np.ones(3))


class TestFit:
    @pytest.mark.parametrize("truth", TRUTHS.values(), ids=TRUTHS)
    def test_without_noise_the_truth_comes_out(self, truth: Derivatives) -> None:
        _, found = identified(simulated(truth, 0, noise=0.0))
        wanted = truth.as_array()
        assert found.derivatives.as_array()[2:] == pytest.approx(wanted[2:], rel=0.01)
        assert found.derivatives.as_array()[:2] == pytest.approx(wanted[:2], abs=0.02)
        assert found.motor_lag_s[0] == pytest.approx(LAG_S, abs=5e-4)

    @pytest.mark.parametrize("truth", TRUTHS.values(), ids=TRUTHS)
    def test_the_intervals_hold_the_truth_as_often_as_they_say(self, truth: Derivatives) -> None:
        inside, width = [], []
        for seed in range(12):
            _, found = identified(simulated(truth, seed))
            off = np.abs(found.derivatives.as_array() - truth.as_array())
            inside.append(off <= found.interval_95.as_array())
            width.append(found.interval_95.as_array() / np.abs(truth.as_array()))
        assert np.mean(inside) >= 0.9
        # and they are no excuse: the strong derivatives are known to a few per cent
        assert np.max(np.array(width)[:, [2, 3, 5]]) < 0.06

    def test_more_periods_make_narrower_intervals(self) -> None:
        truth = TRUTHS["small"]
        short = [identified(simulated(truth, seed, length_s=44.0), 44.0)[1] for seed in range(4)]
        long = [identified(simulated(truth, seed, length_s=164.0), 164.0)[1] for seed in range(4)]
        narrow, wide = (
            np.median([one.interval_95.as_array() for one in each], axis=0)[[0, 1, 2]] for each in (long, short)
        )
        assert (narrow < 0.8 * wide).all()

    def test_gravity_counts_at_the_amplitude_that_was_flown(self) -> None:
        columns = simulated(TRUTHS["small"], 0, noise=0.0)
        measured, _ = identified(columns)
        phi = columns["phi_rad"]
        assert measured.gravity_m_s2 == pytest.approx(G * (np.sin(phi) @ phi) / (phi @ phi), rel=2e-3)

    def test_the_model_is_equation_2_2(self) -> None:
        truth = TRUTHS["large"]
        Yv, Yp, Yd, Lv, Lp, Ld = truth.as_array()
        omega = np.array([0.3, 4.0, 30.0])
        a = np.array([[Yv, Yp, G], [Lv, Lp, 0.0], [0.0, 1.0, 0.0]])
        b = np.array([Yd, Ld, 0.0])
        x = np.array([np.linalg.solve(1j * w * np.eye(3) - a, b) for w in omega])
        p, v = model(np.array([*truth.as_array(), 0.0, 0.0, 0.0]), omega)
        assert p == pytest.approx(x[:, 1])
        assert v == pytest.approx(x[:, 0])

    def test_what_the_data_hardly_tell_is_named(self) -> None:
        """Without any effect of sideways damping on the motion, its value is a guess, and said to be one."""
        truth = dataclasses.replace(TRUTHS["small"], Yp=0.001)
        _, found = identified(simulated(truth, 1))
        assert "Yp" in found.unknown
        assert "Ld" not in found.unknown


class TestBadFlights:
    def excitation(self, end_s: float = LENGTH_S) -> Excitation:
        return Excitation(START_S, START_S + end_s, FREQUENCIES)

    def test_noise_alone(self) -> None:
        columns = simulated(TRUTHS["small"], 0)
        rng = np.random.default_rng(2)
        columns["p_rad_s"] = rng.normal(0.0, 0.1, len(columns["t_s"]))
        columns["v_east_m_s"] = rng.normal(0.0, 0.1, len(columns["t_s"]))
        with pytest.raises(UsageError, match="not enough excitation"):
            identified(columns)

    def test_saturated_motors(self) -> None:
        columns = simulated(TRUTHS["small"], 0)
        columns["motor2"] = np.where(np.arange(len(columns["t_s"])) % 5 == 0, 1.0, 0.5)
        with pytest.raises(UsageError, match=r"limits in 20 %.*smaller peak_deg"):
            identified(columns)

    def test_a_limit_cycle(self) -> None:
        columns = simulated(TRUTHS["small"], 0)
        columns["q_rad_s"] = 2.0 * np.sin(2.0 * np.pi * 9.0 * columns["t_s"])
        with pytest.raises(UsageError, match="identify on gains that fly without oscillation"):
            identified(columns)

    @pytest.mark.parametrize("column", ["delta_lat", "p_rad_s", "v_east_m_s"])
    def test_a_column_that_was_not_recorded(self, column: str) -> None:
        columns = simulated(TRUTHS["small"], 0)
        del columns[column]
        with pytest.raises(UsageError, match="not recorded"):
            identified(columns)

    def test_too_short(self) -> None:
        with pytest.raises(UsageError, match="only 2 whole periods"):
            responses(Telemetry.from_columns(simulated(TRUTHS["small"], 0, length_s=28.0)), self.excitation(28.0))

    def test_broken_off_before_it_began(self) -> None:
        columns = {name: values[:400] for name, values in simulated(TRUTHS["small"], 0).items()}
        with pytest.raises(UsageError, match="not recorded"):
            responses(Telemetry.from_columns(columns), self.excitation())

    def test_a_flight_without_a_multisine(self) -> None:
        step = {"name": "step", "kind": "step", "settings": {}}
        with pytest.raises(FileError, match=r"holds no multisine.*identify"):
            excitation_of([step], [Segment("step/1", "step", "step", 1.0, 2.0, 0.1, 0.0)], Path("flight.parquet"))

    def test_a_multisine_that_was_not_reached(self) -> None:
        flown = {"name": "id", "kind": "multisine", "settings": {"frequencies_hz": [1.0], "fade_s": 1.0}}
        with pytest.raises(FileError, match="holds no multisine"):
            excitation_of([flown], [], Path("flight.parquet"))


Froude = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The library's scenario, flown over memory on ADAM-0, whose derivatives are hardest to tell apart."""
    out = tmp_path_factory.mktemp("flown")
    words = ["fly", "identify", "--vehicle", "adam-0", "--gains", "table_2_2/ADAM-0", "--out", str(out)]
    assert main(words) == 0
    (folder,) = out.iterdir()
    return folder


@pytest.fixture
def froude(capsys: pytest.CaptureFixture[str]) -> Froude:
    def run(*words: object) -> tuple[int, str, str]:
        capsys.readouterr()
        status = main([str(word) for word in words])
        out, err = capsys.readouterr()
        return status, out, err

    return run


class TestFromAFlight:
    def test_the_file_is_an_airframe_with_the_truth_in_it(
        self, run_folder: Path, froude: Froude, tmp_path: Path
    ) -> None:
        file = tmp_path / "mine.toml"
        status, out, err = froude("identify", run_folder, "--name", "MINE", "--out", file)
        assert (status, err) == (0, "")
        truth, made = load_airframe("adam-0"), load_airframe(file)
        assert made.name == "MINE"
        assert made.derivatives.as_array() == pytest.approx(truth.derivatives.as_array(), rel=0.03)
        assert made.derivatives.as_array()[2:] == pytest.approx(truth.derivatives.as_array()[2:], rel=0.01)
        assert made.derivatives.Ld == pytest.approx(truth.derivatives.Ld, rel=0.001)
        assert made.assumptions.motor_lag_s == pytest.approx(truth.assumptions.motor_lag_s, abs=5e-4)
        assert (made.mass_kg, made.rotors, made.flight_gains) == (truth.mass_kg, truth.rotors, truth.flight_gains)
        deviation = np.abs(made.derivatives.as_array() * made.sigma_pct.as_array() / 100.0)
        assert (np.abs(made.derivatives.as_array() - truth.derivatives.as_array()) < 3.0 * deviation).all()
        for name in DERIVATIVE_NAMES:
            assert f"{getattr(made.derivatives, name):.5g}" in out
        assert "truth" in out
        assert froude("model", file)[0] == 0

    def test_the_same_flight_gives_the_same_bytes(self, run_folder: Path, froude: Froude, tmp_path: Path) -> None:
        (parquet,) = (run_folder / "flights").glob("*.parquet")
        for name, where in (("a.toml", run_folder), ("b.toml", parquet)):
            assert froude("identify", where, "--out", tmp_path / name)[0] == 0
        assert (tmp_path / "a.toml").read_bytes() == (tmp_path / "b.toml").read_bytes()

    def test_json_says_it_all(self, run_folder: Path, froude: Froude, tmp_path: Path) -> None:
        file = tmp_path / "mine.toml"
        status, out, _ = froude("identify", run_folder, "--out", file, "--json")
        shown = json.loads(out)
        assert status == 0
        assert shown["file"] == str(file)
        assert shown["model_is_truth"] is True
        assert shown["responses"]["p_per_delta_lat"]["frequency_hz"] == pytest.approx(FREQUENCIES.tolist())
        assert min(shown["responses"]["v_per_delta_lat"]["coherence"]) > 0.9
        ld = shown["derivatives"]["Ld"]
        assert ld["model"] == load_airframe("adam-0").derivatives.Ld
        assert ld["model_inside"] == (abs(ld["value"] - ld["model"]) <= ld["interval_95"])

    def test_the_magnitudes_are_those_of_the_plant(self, run_folder: Path, froude: Froude, tmp_path: Path) -> None:
        """Measured p per delta_lat beside the plant with its motor lag, at every frequency."""
        shown = json.loads(froude("identify", run_folder, "--out", tmp_path / "x.toml", "--json")[1])
        truth = load_airframe("adam-0")
        Yv, Yp, Yd, Lv, Lp, Ld = truth.derivatives.as_array()
        a = np.array([[Yv, Yp, G], [Lv, Lp, 0.0], [0.0, 1.0, 0.0]])
        omega = 2.0 * np.pi * FREQUENCIES
        gain = [
            abs(
                np.linalg.solve(1j * w * np.eye(3) - a, [Yd, Ld, 0.0])[1]
                / (1.0 + 1j * w * truth.assumptions.motor_lag_s)
            )
            for w in omega
        ]
        assert shown["responses"]["p_per_delta_lat"]["magnitude"] == pytest.approx(gain, rel=0.02)

    def test_another_body(self, run_folder: Path, froude: Froude, tmp_path: Path) -> None:
        file = tmp_path / "x.toml"
        assert froude("identify", run_folder, "--airframe", "ant-r", "--out", file)[0] == 0
        assert load_airframe(file).name == "ANT-R-identified"
        assert load_airframe(file).mass_kg == load_airframe("ant-r").mass_kg


class TestWhatCannotBeIdentified:
    @pytest.mark.parametrize(
        ("words", "wanted"),
        [
            (["--name", "my aircraft"], "--name 'my aircraft' is not a name"),
            (["--out", "airframe.json"], "an airframe is a .toml file"),
            (["--airframe", "ant-y"], 'unknown airframe "ant-y"'),
        ],
    )
    def test_bad_words(self, run_folder: Path, froude: Froude, words: list[str], wanted: str) -> None:
        status, out, err = froude("identify", run_folder, *words)
        assert (status, out) == (2, "")
        assert wanted in err
        assert "Traceback" not in err

    def test_no_run_there(self, froude: Froude, tmp_path: Path) -> None:
        for path in (tmp_path, tmp_path / "nothing", tmp_path / "flights" / "x.parquet"):
            status, _, err = froude("identify", path)
            assert status == 2
            assert "Give the folder of a run" in err

    def test_below_a_file(self, run_folder: Path, froude: Froude, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("")
        status, _, err = froude("identify", run_folder, "--out", tmp_path / "file" / "x.toml")
        assert status == 2
        assert "its folder cannot be made" in err

    def test_several_flights(self, run_folder: Path, froude: Froude, tmp_path: Path) -> None:
        run = load_run(run_folder)
        run["flights"] *= 2
        copy = tmp_path / "copy"
        copy.mkdir()
        (copy / "run.json").write_text(json.dumps(run))
        status, _, err = froude("identify", copy)
        assert status == 2
        assert "holds 2 flights" in err
        assert ".parquet" in err
        run["flights"] = []
        (copy / "run.json").write_text(json.dumps(run))
        assert "holds no recorded flight" in froude("identify", copy)[2]

    def test_motors_the_wrong_way_round(self, run_folder: Path, froude: Froude, tmp_path: Path) -> None:
        """The mix of another motor order: positive commands roll it left."""
        run = load_run(run_folder)
        (flight,) = run["flights"]
        telemetry, about = Telemetry.from_parquet(run_folder / flight["files"]["parquet"])
        columns = dict(telemetry.columns) | {"delta_lat": -telemetry["delta_lat"]}
        (tmp_path / "flights").mkdir()
        Telemetry.from_columns(columns).to_parquet(tmp_path / flight["files"]["parquet"], about)
        (tmp_path / "run.json").write_text(json.dumps(run))
        status, _, err = froude("identify", tmp_path, "--out", tmp_path / "x.toml")
        assert status == 2
        assert "not above 0" in err
        assert not (tmp_path / "x.toml").exists()
