"""What is known of a vehicle, as data and as text: `froude model`."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from scenarios.run_folder import plain, vehicle_description
from sitl.lateral import LateralModel
from sitl.profile import Profile
from sitl.sampled_loop import RollGains
from sitl.stability import loop_margins
from sitl.vehicle_spec import VehicleModel


def model_object(model: VehicleModel, profile: Profile) -> dict[str, Any]:
    """A vehicle as plain data: derivatives, matrices, modes, and the margins of its own flight gains.

    Args:
        model: the vehicle. profile: whose rates, filters and delays the margins are for.
    """
    lateral = LateralModel.from_derivatives(model.derivatives)
    shown = vehicle_description(model)
    shown["state_space"] = {name: getattr(lateral, name).tolist() for name in "ABCD"}
    shown["modes"] = [
        {"name": m.name, "natural_frequency_rad_s": m.wn_rad_s, "damping_ratio": m.zeta} for m in lateral.modes()
    ]
    shown["profile"] = profile.name
    lag_s = profile.motor_lag(model.assumptions.motor_lag_s)
    gains = model.airframe.flight_gains
    shown["flight_gain_margins"] = (
        None
        if gains is None
        else asdict(loop_margins(model.derivatives, RollGains.from_flight_gains(gains), profile, lag_s))
    )
    plain_object: dict[str, Any] = plain(shown)
    return plain_object


def model_text(shown: dict[str, Any]) -> str:
    """The same for people.

    Args:
        shown: from ``model_object``.
    """
    lines = [f"{shown['name']}  {shown['title']}"]
    if shown["reference"]:
        lines.append(
            f"  predicted from {shown['reference']}, N = {shown['froude_number']:.4f}, "
            f"scaling {', '.join(shown['scaling']) or 'none'}"
        )
    lines.append(
        f"  {shown['layout']}, {len(shown['rotors'])} rotors, {shown['mass_kg']:g} kg, "
        f"diagonal {shown['diagonal_m']:g} m"
    )
    lines += ["", "  derivative      value  unit        sigma %"]
    for name, value in shown["derivatives"].items():
        lines.append(
            f"  {name:<10} {value:>10.5g}  {shown['derivative_units'][name]:<10} {shown['sigma_pct'][name]:>8.4g}"
        )
    lines += ["", "  mode                      natural frequency rad/s  damping"]
    for mode in shown["modes"]:
        lines.append(f"  {mode['name']:<25} {mode['natural_frequency_rad_s']:>23.3f}  {mode['damping_ratio']:>7.3f}")
    margins = shown["flight_gain_margins"]
    if margins is not None:
        lines += ["", f"  its own flight gains, loop cut at delta_lat, profile {shown['profile']}:"]
        delay, phase = margins["delay_margin_s"], margins["phase_margin_deg"]
        if margins["closed_loop_stable"]:
            delay_text = "no limit" if delay is None else f"{delay * 1e3:.1f} ms"
            phase_text = "no limit" if phase is None else f"{phase:.1f} deg"
            lines.append(f"  stable, phase margin {phase_text}, delay margin {delay_text}")
        else:
            missing = "" if delay is None else f": the torque would have to act {-delay * 1e3:.1f} ms earlier"
            lines.append(f"  UNSTABLE{missing}")
    lines += [
        "",
        "  assumed, not measured: " + ", ".join(f"{k} {v:g}" for k, v in shown["assumptions"].items()),
    ]
    return "\n".join(lines)
