"""Margins against eigenvalues, an independent simulation, the continuous loop, and a real PX4's flights."""

import math
import tomllib
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sitl.airframe import Derivatives, load_airframe
from sitl.lateral import LateralModel
from sitl.profile import Profile, get_profile
from sitl.sampled_loop import SampledLoop
from sitl.stability import Margins, RollGains, loop_margins, loop_transfer, margins_of
from sitl.vehicle_spec import resolve_vehicle

STUDY = tomllib.loads((Path(__file__).parents[1] / "data" / "study.toml").read_text())
AIRFRAMES = tuple(STUDY["airframe"])
SITL, BOARD, BARE = get_profile("sitl"), get_profile("board"), get_profile("study")
PX4_DEFAULTS = RollGains(k_phi=4.0, k=1.0, kp=0.15, ki=0.2, kd=0.003)


def derivatives(name: str) -> Derivatives:
    return load_airframe(name).derivatives


def flight(name: str) -> RollGains:
    gains = load_airframe(name).flight_gains
    assert gains is not None
    return RollGains.from_flight_gains(gains)


def hinf(target: str, based_on: str) -> RollGains:
    g = STUDY["hinf_gains"]["ADAM-0" if target == "CARRIER-1" else target][based_on]
    return RollGains(k_phi=g["K_phi"], k=1.0, kp=g["K_P"], ki=g["K_I"], kd=g["K_D"])


def spectral_radius(loop: SampledLoop, gain: float = 1.0) -> float:
    return float(np.abs(loop.eigenvalues(gain)).max())


# Loops of every kind: stable and not, filtered and bare, with and without lag, delay, lateness, feed-forward.
ARGUMENTS: dict[str, tuple[Any, ...]] = {
    "flight, sitl": (derivatives("ANT-X"), flight("ANT-X"), SITL, 0.025),
    "marginal": (derivatives("ANT-R"), flight("ANT-R"), SITL, 0.01),
    "board": (derivatives("CARRIER-1"), flight("CARRIER-1"), BOARD, 0.02),
    "cycles": (derivatives("ANT-X"), hinf("ANT-X", "CARRIER-1"), SITL, 0.025),
    "never stable": (derivatives("ANT-X"), hinf("ANT-X", "ANT-X"), SITL, 0.01),
    "bare": (derivatives("ANT-R"), hinf("ANT-R", "ANT-X"), BARE, 0.0),
    "fraction of a tick": (derivatives("ADAM-0"), flight("ADAM-0"), SITL, 0.01, 0.0095),
    "no integrator": (derivatives("ADAM-0"), RollGains(6.5, 1.0, 0.15, 0.0, 0.003), SITL, 0.02),
    "feed-forward, k": (derivatives("ADAM-0"), RollGains(5, 1.5, 0.1, 0.3, 0.002, 0.05), SITL, 0.0),
    "late attitude": (
        derivatives("ANT-X"),
        flight("ANT-X"),
        get_profile("sitl", attitude_late_ticks=3.25),
        0.025,
    ),
}
LOOPS = {name: SampledLoop(*arguments) for name, arguments in ARGUMENTS.items()}
STABLE = {name: loop for name, loop in LOOPS.items() if spectral_radius(loop) < 1.0}


def simulate(
    d: Derivatives, g: RollGains, profile: Profile, lag: float, delay: float, ticks: int, substeps: int
) -> np.ndarray:
    """p at every tick, flown from phi = 0.1 by the tick's definition; plant by Runge-Kutta in substeps."""
    dt = profile.dt_s
    h = dt / substeps
    m = LateralModel.from_derivatives(d)
    warp = math.tan(math.pi * profile.gyro_cutoff_hz * dt) if profile.gyro_cutoff_hz else 0.0
    fc = profile.dgyro_cutoff_hz
    weight = dt / (dt + 1.0 / (2.0 * math.pi * fc)) if fc else 1.0

    def slope(x: np.ndarray, u: float) -> np.ndarray:
        torque = x[3] if lag else u
        return np.append(m.A @ x[:3] + m.B[:, 0] * torque, (u - x[3]) / lag if lag else 0.0)

    x = np.array([0.0, 0.0, 0.1, 0.0])
    p_old, y_old, angles, commands = [0.0, 0.0], [0.0, 0.0], [0.0] * 10, [0.0] * 100
    alpha = integral = 0.0
    history = []
    for _ in range(ticks):
        p, phi = float(x[1]), float(x[2])
        if warp:
            norm = 1.0 + math.sqrt(2.0) * warp + warp**2
            y = (
                warp**2 * (p + 2.0 * p_old[0] + p_old[1])
                - 2.0 * (warp**2 - 1.0) * y_old[0]
                - (1.0 - math.sqrt(2.0) * warp + warp**2) * y_old[1]
            ) / norm
        else:
            y = p
        alpha += weight * ((y - y_old[0]) / dt - alpha)
        p_old, y_old, angles = [p, p_old[0]], [y, y_old[0]], [phi, *angles[:-1]]
        age = profile.attitude_late_ticks + profile.rate_sp_late_ticks
        whole = math.floor(age)
        late = (1.0 - age + whole) * angles[whole] + (age - whole) * angles[whole + 1]
        r = -g.k_phi * late
        delta = g.k * g.kp * (r - y) + integral - g.k * g.kd * alpha + g.kff * r
        integral += g.k * g.ki * (r - y) * dt
        commands = [delta, *commands[:-1]]
        for i in range(substeps):
            age_s = (i + 0.5) * h - profile.transport_delay_ticks * dt - delay
            u = commands[max(0, -math.floor(age_s / dt))]
            k1 = slope(x, u)
            k2 = slope(x + 0.5 * h * k1, u)
            k3 = slope(x + 0.5 * h * k2, u)
            x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + slope(x + h * k3, u))
        history.append(float(x[1]))
    return np.array(history)


@pytest.mark.parametrize(
    ("profile", "lag", "delay"),
    [(BARE, 0.0, 0.0), (SITL, 0.0, 0.0), (SITL, 0.025, 0.0), (BOARD, 0.01, 0.0), (SITL, 0.01, 0.0095)],
)
def test_the_matrix_of_one_tick_is_the_loop_flown_by_its_definition(profile: Profile, lag: float, delay: float) -> None:
    d, g = derivatives("ADAM-0"), RollGains(6.5, 1.2, 0.15, 0.4, 0.003, 0.02)
    loop = SampledLoop(d, g, profile, lag, delay)
    matrix = loop.closed_loop_matrix()
    state = np.zeros(len(matrix))
    state[2] = 0.1
    flown = []
    for _ in range(120):
        state = matrix @ state
        flown.append(state[1])
    simulated = simulate(d, g, profile, lag, delay, ticks=120, substeps=8)
    assert np.array(flown) == pytest.approx(simulated, rel=1e-6, abs=1e-6 * np.abs(simulated).max())


@pytest.mark.parametrize("name", LOOPS)
def test_transfer_function_and_matrix_are_one_loop(name: str) -> None:
    """1 + g L(z) = det(z - closed(g)) / det(z - closed(0)) all over the unit circle, in size and phase."""
    loop = LOOPS[name]
    omega = np.array([0.05, 0.7, 4.0, 19.0, 80.0, 0.4 / loop.dt_s, 3.0 / loop.dt_s, math.pi / loop.dt_s])
    z = np.exp(1j * omega * loop.dt_s)
    for gain in (1.0, 0.3):
        closed, cut = (loop.eigenvalues(g) for g in (gain, 0.0))
        ratio = np.prod((z[:, None] - closed) / (z[:, None] - cut), axis=1)
        assert 1.0 + gain * loop.transfer(omega) == pytest.approx(ratio, rel=1e-6)


@pytest.mark.parametrize("name", STABLE)
def test_gain_margins_are_where_an_eigenvalue_meets_the_unit_circle(name: str) -> None:
    loop = STABLE[name]
    m = margins_of(loop)
    assert m.closed_loop_stable
    assert m.gain_margin_low_db is not None
    assert m.gain_margin_high_db is not None
    assert m.gain_margin_low_db < 0.0 < m.gain_margin_high_db
    for margin_db, outwards in ((m.gain_margin_low_db, 0.97), (m.gain_margin_high_db, 1.03)):
        inside, outside = 1.0, 10.0 ** (margin_db / 20.0) * outwards
        assert spectral_radius(loop, outside) > 1.0
        for _ in range(50):
            middle = math.sqrt(inside * outside)
            if spectral_radius(loop, middle) < 1.0:
                inside = middle
            else:
                outside = middle
        assert 20.0 * math.log10(inside) == pytest.approx(margin_db, abs=1e-5)
    # No gain between the two loses it: the first limit met on either side is the one reported.
    for gain_db in np.linspace(m.gain_margin_low_db + 1e-3, m.gain_margin_high_db - 1e-3, 60):
        assert spectral_radius(loop, 10.0 ** (gain_db / 20.0)) < 1.0


def delay_that_loses(d: Derivatives, g: RollGains, profile: Profile, lag: float, most: float) -> float:
    """Least added delay at which an eigenvalue leaves the unit circle, by scanning and bisection."""

    def stable(delay: float) -> bool:
        return spectral_radius(SampledLoop(d, g, profile, lag, delay)) < 1.0

    delays = np.linspace(0.0, most, 60)
    first = next(i for i, delay in enumerate(delays) if not stable(float(delay)))
    inside, outside = float(delays[first - 1]), float(delays[first])
    for _ in range(30):
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if stable(middle) else (inside, middle)
    return inside


@pytest.mark.parametrize(
    ("name", "gains", "lag"),
    [
        ("ANT-X", "flight", 0.025),
        ("ANT-R", "flight", 0.01),
        ("ANT-R", "flight", 0.05),
        ("CARRIER-1", "flight", 0.01),
        ("ADAM-0", "flight", 0.025),
        ("ANT-X", "ANT-R", 0.01),
        ("ANT-X", "ADAM-0", 0.01),
        ("ADAM-0", "ANT-X", 0.01),
    ],
)
def test_delay_margin_is_the_delay_that_loses_the_loop(name: str, gains: str, lag: float) -> None:
    d, g = derivatives(name), flight(name) if gains == "flight" else hinf(name, gains)
    m = loop_margins(d, g, SITL, lag)
    assert m.delay_margin_s is not None
    found = delay_that_loses(d, g, SITL, lag, 1.5 * m.delay_margin_s + 0.001)
    assert m.delay_margin_s == pytest.approx(found, abs=2e-5)


@pytest.mark.parametrize("name", AIRFRAMES)
def test_without_lag_the_delay_margin_errs_little_and_on_the_safe_side(name: str) -> None:
    m = loop_margins(derivatives(name), flight(name), SITL, 0.0)
    assert m.delay_margin_s is not None
    found = delay_that_loses(derivatives(name), flight(name), SITL, 0.0, 1.5 * m.delay_margin_s + 0.002)
    assert m.delay_margin_s <= found <= m.delay_margin_s + 0.6e-3


@pytest.mark.parametrize("name", ["flight, sitl", "marginal", "board", "bare", "late attitude"])
def test_ticks_of_delay_come_off_the_margin_and_turn_it_negative(name: str) -> None:
    """A delay of whole ticks only turns L: the margin is exact, and beyond it says what must be removed."""
    d, gains, profile, lag = ARGUMENTS[name]
    margin = loop_margins(d, gains, profile, lag).delay_margin_s
    assert margin is not None
    for ticks in (1, 2, math.ceil(margin / profile.dt_s) + 1):
        delay = ticks * profile.dt_s
        m = loop_margins(d, gains, profile, lag, delay)
        assert m.delay_margin_s == pytest.approx(margin - delay, abs=1e-9)
        assert m.closed_loop_stable == (margin > delay)
        assert m.phase_margin_deg is not None
        assert (m.phase_margin_deg > 0.0) == m.closed_loop_stable


@pytest.mark.parametrize("name", LOOPS)
def test_crossover_phase_and_modulus_margins_agree_with_a_dense_grid(name: str) -> None:
    loop = LOOPS[name]
    m = margins_of(loop)
    omega = np.geomspace(1e-3, math.pi / loop.dt_s, 200_000)
    value = loop.transfer(omega)
    assert m.modulus_margin == pytest.approx(np.abs(1.0 + value).min(), abs=1e-6)
    crossing = np.flatnonzero((np.abs(value[:-1]) > 1.0) != (np.abs(value[1:]) > 1.0))
    falling = crossing[np.abs(value[crossing]) > 1.0]
    assert m.crossover_rad_s == pytest.approx(omega[falling[-1]], rel=1e-4)
    margins = np.abs(np.degrees(np.angle(-value[crossing])))
    if m.closed_loop_stable:
        assert m.phase_margin_deg == pytest.approx(margins.min(), abs=0.02)
    else:
        assert m.phase_margin_deg is None or m.phase_margin_deg < 0.0


def test_an_unstable_loop_says_what_would_make_it_stable() -> None:
    """ANT-X on the set designed for CARRIER-1 cycles at 25 ms of lag: 6 dB or 3.5 ms too much."""
    loop = LOOPS["cycles"]
    m = margins_of(loop)
    assert not m.closed_loop_stable
    assert m.gain_margin_low_db is not None
    assert m.gain_margin_high_db is not None
    assert m.gain_margin_low_db < m.gain_margin_high_db < 0.0
    edge = 10.0 ** (m.gain_margin_high_db / 20.0)
    assert spectral_radius(loop, 0.999 * edge) < 1.0 < spectral_radius(loop, 1.001 * edge)
    assert m.delay_margin_s is not None
    assert -loop.delay_s < m.delay_margin_s < 0.0


def test_a_loop_that_no_gain_makes_stable_says_so() -> None:
    loop = LOOPS["never stable"]
    m = margins_of(loop)
    assert (m.gain_margin_low_db, m.gain_margin_high_db, m.phase_crossover_rad_s) == (None, None, None)
    assert all(spectral_radius(loop, gain) >= 1.0 for gain in np.geomspace(1e-4, 1e3, 60))


def test_the_bare_loop_s_upper_gain_limit_is_at_half_the_tick_rate() -> None:
    """The crossing at z = -1, which tools that look only below it leave out."""
    loop = LOOPS["bare"]
    m = margins_of(loop)
    assert m.phase_crossover_rad_s == pytest.approx(math.pi / loop.dt_s)
    assert m.gain_margin_high_db is not None
    leaving = loop.eigenvalues(10.0 ** (m.gain_margin_high_db / 20.0))
    assert leaving[np.argmax(np.abs(leaving))] == pytest.approx(-1.0, abs=1e-6)


def test_a_stable_airframe_has_no_lower_gain_limit() -> None:
    d = Derivatives(Yv=-5.0, Yp=0.0, Yd=0.0, Lv=-1.0, Lp=-20.0, Ld=300.0)
    m = loop_margins(d, RollGains(5.0, 1.0, 0.1, 0.1, 0.0), SITL, 0.02)
    assert m.closed_loop_stable
    assert m.gain_margin_low_db is None


def test_a_loop_too_weak_to_matter_has_every_margin() -> None:
    d = Derivatives(Yv=-5.0, Yp=0.0, Yd=0.0, Lv=-1.0, Lp=-20.0, Ld=300.0)
    m = loop_margins(d, RollGains(1e-3, 1.0, 1e-4, 0.0, 0.0), SITL, 0.02)
    assert m.closed_loop_stable
    assert (m.phase_margin_deg, m.delay_margin_s, m.crossover_rad_s) == (math.inf, math.inf, None)


def test_no_gain_at_all_leaves_the_airframe_as_unstable_as_it_is() -> None:
    m = loop_margins(derivatives("ANT-X"), RollGains(0.0, 0.0, 0.0, 0.0, 0.0), SITL, 0.02)
    assert not m.closed_loop_stable
    assert (m.gain_margin_high_db, m.delay_margin_s) == (None, None)


def continuous_margins(d: Derivatives, g: RollGains) -> tuple[float, float, float]:
    """(lower gain margin dB, phase margin deg, crossover rad/s) of the unsampled loop, from polynomial roots.

    L(s) = (kp + ki/s)(p + k_phi phi) + kd s p, over delta_lat.
    """
    den = np.polymul([1.0, -(d.Lp + d.Yv), d.Lp * d.Yv - d.Lv * d.Yp, -9.81 * d.Lv], [1.0, 0.0])
    phi = np.array([d.Ld, -d.Ld * d.Yv + d.Lv * d.Yd])
    pi = np.array([g.kp, g.ki])
    num = np.polymul(phi, np.polyadd(np.polymul(pi, [1.0, g.k_phi]), [g.kd, 0.0, 0.0, 0.0]))

    def at_jw(poly: np.ndarray) -> np.ndarray:
        n = len(poly) - 1
        return np.array([c * 1j ** (n - i) for i, c in enumerate(poly)])

    n, e = at_jw(num), at_jw(den)
    size = np.polysub(np.polymul(n, n.conj()), np.polymul(e, e.conj())).real
    turn = np.polymul(n, e.conj()).imag

    def value(w: float) -> complex:
        return complex(np.polyval(num, 1j * w) / np.polyval(den, 1j * w))

    def positive(poly: np.ndarray) -> list[float]:
        roots = np.roots(np.trim_zeros(poly, "f"))
        return sorted(float(r.real) for r in roots if abs(r.imag) < 1e-6 * abs(r) and r.real > 1e-3)

    crossovers = positive(size)
    low = max(-1.0 / value(w).real for w in positive(turn) if value(w).real < -1.0)
    phase = min(abs(math.degrees(np.angle(-value(w)))) for w in crossovers)
    return 20.0 * math.log10(low), phase, crossovers[-1]


@pytest.mark.parametrize(("target", "based_on"), list(product(["ANT-R", "ANT-X", "ADAM-0"], AIRFRAMES)))
def test_the_bare_loop_approaches_the_continuous_one_as_the_rate_rises(target: str, based_on: str) -> None:
    """The error falls with the tick, and what is left at no tick at all is the continuous loop."""
    d, g = derivatives(target), hinf(target, based_on)
    expected = np.array(continuous_margins(d, g))

    def sampled(rate_hz: int) -> np.ndarray:
        m = loop_margins(d, g, replace(BARE, rate_hz=rate_hz), 0.0)
        assert m.closed_loop_stable
        return np.array([m.gain_margin_low_db, m.phase_margin_deg, m.crossover_rad_s], dtype=float)

    slow, fast, fastest = sampled(1000), sampled(8000), sampled(16000)
    slow[1] += math.degrees(slow[2] * 0.0005)  # half a tick of hold at 1 kHz
    assert slow == pytest.approx(expected, rel=0.03)
    assert 2.0 * fastest - fast == pytest.approx(expected, rel=3e-4)


@pytest.mark.parametrize(
    ("profile", "lag", "delay"), [(BARE, 0.0, 0.0), (SITL, 0.0, 0.0), (SITL, 0.02, 0.003), (BOARD, 0.01, 0.0)]
)
def test_loop_delay_is_the_phase_that_the_loop_s_elements_cost(profile: Profile, lag: float, delay: float) -> None:
    """P control of the rate alone: L over the plant's own frequency response is those elements."""
    d, omega = derivatives("ANT-X"), 2.0
    gains = RollGains(k_phi=0.0, k=1.0, kp=0.1, ki=0.0, kd=0.0)
    value = loop_transfer(omega, d, gains, profile, lag, delay)
    m = LateralModel.from_derivatives(d)
    plant = np.linalg.solve(1j * omega * np.eye(3) - m.A, m.B.astype(complex))[1, 0]
    measured = -np.angle(value / plant) / omega
    assert loop_margins(d, gains, profile, lag, delay).loop_delay_s == pytest.approx(measured, rel=5e-3)


def stable(target: str, gains: RollGains, lag: float, profile: Profile = SITL) -> bool:
    return loop_margins(derivatives(target), gains, profile, lag).closed_loop_stable


@pytest.mark.parametrize(("name", "lag"), list(product(AIRFRAMES, [0.0, 0.01, 0.025, 0.05])))
def test_the_gains_that_flew_fly(name: str, lag: float) -> None:
    assert stable(name, flight(name), lag)


# A real PX4 in lockstep, roll steps in offboard attitude: the motor lags, ms, at which a set did not cycle.
PX4_STABLE_AT = {
    ("ANT-X", "ANT-R"): {0, 10},
    ("ANT-X", "ANT-X"): set(),
    ("ANT-X", "CARRIER-1"): {0},
    ("ANT-X", "ADAM-0"): {0, 10, 25},
    ("ADAM-0", "ANT-R"): {0, 10},
    ("ADAM-0", "ANT-X"): {0, 10},
    ("ADAM-0", "CARRIER-1"): {0},
    ("ADAM-0", "ADAM-0"): set(),
    ("ANT-R", "ANT-R"): set(),
    ("ANT-R", "ANT-X"): set(),
    ("ANT-R", "CARRIER-1"): set(),
    ("ANT-R", "ADAM-0"): set(),
    ("CARRIER-1", "ANT-R"): {0, 10},
    ("CARRIER-1", "ANT-X"): {0},
    ("CARRIER-1", "CARRIER-1"): {0},
    ("CARRIER-1", "ADAM-0"): set(),
}


@pytest.mark.parametrize(("pair", "lag_ms"), list(product(PX4_STABLE_AT, [0, 10, 25])))
def test_verdicts_are_those_of_a_real_px4(pair: tuple[str, str], lag_ms: int) -> None:
    target, based_on = pair
    assert stable(target, hinf(target, based_on), lag_ms / 1000.0) == (lag_ms in PX4_STABLE_AT[pair])


@pytest.mark.parametrize(("lag", "measured_hz"), [(0.0, 35.6), (0.01, 21.2), (0.025, 16.9)])
def test_ant_r_cycles_on_px4_s_defaults_at_the_frequency_measured(lag: float, measured_hz: float) -> None:
    m = loop_margins(derivatives("ANT-R"), PX4_DEFAULTS, SITL, lag)
    assert not m.closed_loop_stable
    assert m.phase_crossover_rad_s is not None
    assert m.phase_crossover_rad_s / (2.0 * math.pi) == pytest.approx(measured_hz, abs=0.3)


def test_ant_r_is_quiet_on_px4_s_defaults_with_slow_motors() -> None:
    assert stable("ANT-R", PX4_DEFAULTS, 0.05)
    assert all(stable(name, PX4_DEFAULTS, 0.01) for name in AIRFRAMES if name != "ANT-R")


@pytest.mark.parametrize("cutoff_hz", [0.0, 100.0])
def test_adam_0_on_its_own_set_needs_a_faster_gyro_filter(cutoff_hz: float) -> None:
    gains = hinf("ADAM-0", "ADAM-0")
    assert not stable("ADAM-0", gains, 0.0)
    assert stable("ADAM-0", gains, 0.0, get_profile("sitl", gyro_cutoff_hz=cutoff_hz))


def test_ant_r_s_flight_set_bears_less_than_a_tick_more_of_delay() -> None:
    """On a real PX4 at 10 ms of lag it cycles from one tick, 4 ms, on; ANT-X's bears five."""
    margins = loop_margins(derivatives("ANT-R"), flight("ANT-R"), SITL, 0.01)
    assert margins.delay_margin_s is not None
    assert 0.0 < margins.delay_margin_s < 0.004
    assert loop_margins(derivatives("ANT-X"), flight("ANT-X"), SITL, 0.01, 0.02).closed_loop_stable


def test_the_case_at_the_edge_is_at_the_edge() -> None:
    """ANT-R scaled to ANT-X on ANT-X's flight set: grows at 9.5 ms of lag, decays at 10.2 ms."""
    model = resolve_vehicle("ant-r:ant-x")

    def margins(lag: float) -> Margins:
        return loop_margins(model.derivatives, flight("ANT-X"), SITL, lag)

    assert not margins(0.0090).closed_loop_stable
    assert margins(0.0105).closed_loop_stable


@pytest.mark.parametrize(("target", "based_on"), list(product(["ANT-R", "ANT-X", "ADAM-0"], AIRFRAMES)))
def test_on_the_study_s_bare_model_every_set_is_stable(target: str, based_on: str) -> None:
    m = loop_margins(derivatives(target), hinf(target, based_on), BARE, 0.0)
    assert m.closed_loop_stable
    assert m.phase_margin_deg is not None
    assert m.phase_margin_deg > 45.0


@settings(max_examples=60, deadline=None)
@given(
    st.floats(-2.0, 0.0),
    st.sampled_from([0.0, -1e-3, -5.0, 5.0]),
    st.floats(1.0, 1500.0),
    st.floats(0.0, 300.0),
    st.floats(0.0, 40.0),
    st.floats(0.0, 0.5),
    st.sampled_from([SITL, BOARD, BARE]),
    st.sampled_from([0.0, 0.02, 0.5]),
)
def test_margins_agree_with_stability_for_any_model_and_gains(
    Yv: float, Lv: float, Ld: float, bandwidth: float, ki: float, kd: float, profile: Profile, lag: float
) -> None:
    d = Derivatives(Yv=Yv, Yp=0.1, Yd=5.0, Lv=Lv, Lp=-1.0, Ld=Ld)
    gains = RollGains(k_phi=6.0, k=1.0, kp=bandwidth / Ld, ki=ki / Ld, kd=kd / Ld)
    m = loop_margins(d, gains, profile, lag)
    low = -math.inf if m.gain_margin_low_db is None else m.gain_margin_low_db
    has_room = m.gain_margin_high_db is not None and low < 0.0 < m.gain_margin_high_db
    assert has_room == m.closed_loop_stable
    for margin in (m.phase_margin_deg, m.delay_margin_s):
        assert (margin is not None and margin >= 0.0) == m.closed_loop_stable


def test_a_negative_lag_or_delay_is_refused() -> None:
    for lag, delay in ((-0.01, 0.0), (0.01, -0.001), (math.nan, 0.0)):
        with pytest.raises(ValueError, match="0 or more"):
            SampledLoop(derivatives("ANT-X"), flight("ANT-X"), SITL, lag, delay)
