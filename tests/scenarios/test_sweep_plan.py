"""Candidates of a design, their numbers, and the chunks that they are cut into."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scenarios.sweep.axes import ParameterAxis, as_stored
from scenarios.sweep.candidates import Candidates
from scenarios.sweep.evaluation import chunk_steps
from scenarios.sweep.plan import MOST_CHUNK, Plan, make_plan
from scenarios.sweep.sweep_file import LATIN, SEARCH, SOBOL, load_sweep

GAINS = """
[axes]
vehicle = ["ant-x", "ant-r:ant-x", "ant-r"]
MC_ROLL_P = [6.0, 3.0]
MC_ROLLRATE_P = { from = 0.02, to = 0.3, count = 4, scale = "log" }
MC_AIRMODE = [1, 0, 2]
"""

SAMPLED = """
[design]
kind = "{kind}"
points = {points}
seed = {seed}
[axes]
MC_ROLL_P = {{ from = 2.0, to = 12.0 }}
MC_ROLLRATE_P = {{ from = 0.01, to = 0.4, scale = "log" }}
CA_METHOD = {{ from = 0, to = 2 }}
MC_ROLLRATE_K = [1.0, 0.5, 2.0]
"""


def planned(folder: Path, text: str) -> Plan:
    file = folder / "some.toml"
    file.write_text(text)
    return make_plan(load_sweep(file))


@pytest.fixture(scope="module")
def grid(tmp_path_factory: pytest.TempPathFactory) -> Plan:
    return planned(tmp_path_factory.mktemp("grid"), GAINS)


def sampled(folder: Path, kind: str, points: int = 512, seed: int = 1) -> Plan:
    return planned(folder, SAMPLED.format(kind=kind, points=points, seed=seed))


class TestGrid:
    def test_order_is_that_of_the_axes_the_last_varying_quickest(self, grid: Plan) -> None:
        axes = [axis.values for axis in grid.sweep.parameters]
        assert axes[0] == (6.0, 3.0)
        assert axes[2] == (1.0, 0.0, 2.0)
        assert grid.candidates == 24
        assert Candidates(grid).values(0, 24).tolist() == [list(one) for one in itertools.product(*axes)]

    @given(st.integers(0, 24), st.integers(0, 24))
    def test_any_stretch_is_a_part_of_the_whole(self, start: int, stop: int) -> None:
        grid = PLANS["grid"]
        start, stop = sorted((start, stop))
        whole = Candidates(grid).values(0, grid.candidates)
        assert Candidates(grid).values(start, stop).tolist() == whole[start:stop].tolist()


PLANS: dict[str, Plan] = {}


@pytest.fixture(autouse=True, scope="module")
def _plans(grid: Plan) -> None:
    PLANS["grid"] = grid


class TestChunks:
    @settings(max_examples=200, deadline=None)
    @given(st.integers(1, 500), st.integers(1, 60), st.integers(1, 3))
    def test_every_point_is_in_one_chunk(self, candidates: int, block: int, cases: int) -> None:
        whole = PLANS["grid"]
        block = min(block, candidates)
        plan = dataclasses.replace(whole, candidates=candidates, block=block, cases=whole.cases[:cases])
        chunks = [plan.chunk(number) for number in range(plan.chunks)]
        assert [chunk.number for chunk in chunks] == list(range(plan.chunks))
        points = [candidate * cases + chunk.case for chunk in chunks for candidate in range(chunk.start, chunk.stop)]
        assert sorted(points) == list(range(plan.points))
        assert all(0 < chunk.stop - chunk.start <= block for chunk in chunks)
        # the cases of a stretch of candidates follow one another
        assert [chunk.case for chunk in chunks] == list(range(cases)) * plan.blocks
        # as many vehicle-steps as the whole has
        assert sum(chunk_steps(plan, chunk) for chunk in chunks) == sum(
            candidates * plan.samples * sum(round(m.duration_s * case.profile.rate_hz) for m in plan.sweep.manoeuvres)
            for case in plan.cases
        )

    def test_a_chunk_is_half_a_second_of_work_whatever_a_point_takes(self, tmp_path: Path) -> None:
        for samples, rate_hz in ((0, 250), (100, 250), (1000, 1000)):
            text = SAMPLED.format(kind=SOBOL, points=100_000, seed=1) + f"rate_hz = [{rate_hz}]\n"
            plan = planned(tmp_path, f"samples = {samples}\n" + text)
            steps = max(chunk_steps(plan, plan.chunk(n)) for n in (0, plan.chunks - 1))
            assert steps <= 40_000_000 or plan.block == 1
            assert steps > 20_000_000 or plan.block == MOST_CHUNK

    def test_a_search_s_chunks_belong_to_one_generation(self, tmp_path: Path) -> None:
        for generation in (2, 7, 50, 64, 1000):
            text = SAMPLED.format(kind=SEARCH, points=3000, seed=1).replace(
                "points = 3000", f"points = 3000\ngeneration = {generation}"
            )
            plan = planned(tmp_path, text)
            assert generation % plan.block == 0
            for number in range(plan.chunks):
                chunk = plan.chunk(number)
                assert chunk.start // generation == (chunk.stop - 1) // generation


class TestSampled:
    @pytest.mark.parametrize("kind", [SOBOL, LATIN])
    def test_any_cut_is_one_sequence(self, tmp_path: Path, kind: str) -> None:
        plan = sampled(tmp_path, kind)
        whole = Candidates(plan).values(0, 512)
        for cuts in ([0, 512], [0, 1, 2, 300, 512], list(range(0, 513, 64))):
            made = Candidates(plan)
            parts = [made.values(a, b) for a, b in itertools.pairwise(cuts)]
            assert np.concatenate(parts).tolist() == whole.tolist()
        # in any order, and again
        made = Candidates(plan)
        for a, b in ((300, 310), (5, 9), (5, 9), (0, 512), (511, 512)):
            assert made.values(a, b).tolist() == whole[a:b].tolist()

    @pytest.mark.parametrize("kind", [SOBOL, LATIN])
    def test_the_seed_decides(self, tmp_path: Path, kind: str) -> None:
        one, same, other = (Candidates(sampled(tmp_path, kind, seed=seed)).values(0, 64).tolist() for seed in (1, 1, 2))
        assert one == same != other

    def test_a_longer_sobol_design_begins_with_the_shorter(self, tmp_path: Path) -> None:
        short = Candidates(sampled(tmp_path, SOBOL, points=100)).values(0, 100)
        assert Candidates(sampled(tmp_path, SOBOL, points=5000)).values(0, 100).tolist() == short.tolist()

    def test_a_latin_hypercube_has_one_in_every_stratum(self, tmp_path: Path) -> None:
        count = 200
        plan = sampled(tmp_path, LATIN, points=count)
        values = Candidates(plan).values(0, count)
        even = (values[:, 0] - 2.0) / 10.0
        log = np.log(values[:, 1] / 0.01) / np.log(40.0)
        for unit in (even, log):
            # rounding to 32 bits moves a value by less than a thousandth of a stratum
            strata = np.floor(unit * count + 1e-3 * np.sign(0.5 - (unit * count) % 1.0)).astype(int)
            assert sorted(strata.tolist()) == list(range(count))

    def test_sobol_is_balanced(self, tmp_path: Path) -> None:
        values = Candidates(sampled(tmp_path, SOBOL)).values(0, 512)
        halves = [values[:, 0] < 7.0, values[:, 1] < np.sqrt(0.01 * 0.4)]
        for which in itertools.product((False, True), repeat=2):
            assert np.count_nonzero((halves[0] == which[0]) & (halves[1] == which[1])) == 128

    @pytest.mark.parametrize("kind", [SOBOL, LATIN])
    def test_values_are_within_and_as_px4_keeps_them(self, tmp_path: Path, kind: str) -> None:
        plan = sampled(tmp_path, kind)
        values = Candidates(plan).values(0, 512)
        for column, axis in enumerate(plan.sweep.parameters):
            mine = values[:, column]
            assert (mine == mine.astype(np.float32)).all()
            assert mine.min() >= np.float32(axis.low)
            assert mine.max() <= np.float32(axis.high)
        assert set(values[:, 2]) == {0.0, 1.0, 2.0}
        assert set(values[:, 3]) == {1.0, 0.5, 2.0}
        # a choice among values takes them alike
        assert min(np.count_nonzero(values[:, 3] == one) for one in (1.0, 0.5, 2.0)) > 160


class TestAxis:
    @given(st.floats(1e-3, 10.0), st.floats(1.1, 1e3), st.booleans(), st.lists(st.floats(0.0, 1.0), max_size=20))
    def test_a_range_is_never_left_and_keeps_the_order(
        self, low: float, factor: float, log: bool, unit: list[float]
    ) -> None:
        axis = ParameterAxis("MC_ROLL_P", False, (), low, low * factor, log)
        at = axis.at(np.array(sorted(unit)))
        assert (np.diff(at) >= 0.0).all()
        room = 2.0 * np.spacing(np.float32(low * factor))
        assert ((at >= np.float32(low) - room) & (at <= np.float32(low * factor) + room)).all()

    def test_ends_are_reached(self) -> None:
        for log in (False, True):
            axis = ParameterAxis("MC_ROLL_P", False, (), 0.02, 0.3, log)
            assert axis.at(np.array([0.0, 1.0])).tolist() == as_stored(np.array([0.02, 0.3]), False).tolist()

    @given(st.integers(-5, 5), st.integers(1, 9), st.floats(0.0, 1.0))
    def test_whole_numbers(self, low: int, width: int, unit: float) -> None:
        (at,) = ParameterAxis("MC_AIRMODE", True, (), low, low + width).at(np.array([unit])).tolist()
        assert at == int(at)
        assert low <= at <= low + width

    @given(st.floats(0.0, 1.0), st.integers(1, 7))
    def test_one_of_the_values(self, unit: float, count: int) -> None:
        values = tuple(float(k) for k in range(count))
        (at,) = ParameterAxis("MC_ROLL_P", False, values, 0.0, count - 1.0).at(np.array([unit])).tolist()
        assert at == min(int(unit * count), count - 1)
