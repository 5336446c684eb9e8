"""What the parameters say of themselves: those that are obeyed are read somewhere, the others are not."""

from __future__ import annotations

import ast
import re
from pathlib import Path

from sitl.parameters import parameter_specs

ABOUT_PARAMETERS = {"param_corrections.py", "param_file.py"}
"""Modules that name parameters to keep them in order, not to act on them."""


def test_what_the_vehicle_does_not_act_on_says_so() -> None:
    specs = parameter_specs()
    kept = ["EKF2_EN", "MC_AT_EN", "MC_ORBIT_RAD_MAX", "MC_SLOW_DEF_HVEL", "COM_LOW_BAT_ACT"]
    kept += ["MC_BAT_SCALE_EN", "CA_AIRFRAME", "SYS_AUTOSTART", "SYS_HITL"]
    assert not any(specs[name].obeyed for name in kept)
    assert all(specs[name].obeyed for name in ("MC_ROLLRATE_P", "MC_AIRMODE", "THR_MDL_FAC", "CA_ROTOR0_PX"))


def names_in_code() -> set[str]:
    """Parameters that sitl or bridge name outside of docstrings, also by an f-string such as `MC_{axis}RATE_P`."""
    patterns: set[str] = set()
    for package in ("sitl", "bridge"):
        for path in (Path(__file__).parents[2] / package).glob("*.py"):
            if path.name in ABOUT_PARAMETERS:
                continue
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.JoinedStr):
                    parts = [re.escape(str(p.value)) if isinstance(p, ast.Constant) else r"\w*" for p in node.values]
                    patterns.add("".join(parts))
                elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                    patterns.add(re.escape(node.value))
    # at least one whole word of a name must be spelt out, or `{a}_{b}` would stand for all of them
    spelt = [pattern for pattern in patterns if re.search(r"[A-Z]{2}", pattern) and re.fullmatch(r"[\w\\*]+", pattern)]
    return {name for name in parameter_specs() for pattern in spelt if re.fullmatch(pattern, name)}


def test_what_is_obeyed_is_read_and_what_is_kept_is_not() -> None:
    specs = parameter_specs()
    obeyed = {name for name, spec in specs.items() if spec.obeyed}
    read = names_in_code()
    assert not obeyed - read, "move them to parameters_kept.toml, nothing reads them"
    assert not read - obeyed, "move them to parameters.toml, they are no longer without effect"
