"""What a log says before the first sample: whose it is, and every parameter.

Readers choose by these keys: sys_name says whose topics and modes the file has, ver_data_format how positions are
written. ver_hw, ver_sw and the keys that begin with froude_ say that nothing of it was flown outdoors.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from typing import Final

from bridge import ulog
from bridge.identity import PX4_VERSION
from sitl.parameters import ParameterTable, ParameterType, to_raw
from sitl.vehicle import Vehicle

TYPES: Final[dict[ParameterType, str]] = {"INT32": "int32_t", "REAL32": "float"}
"""ULog's names of the parameter types."""

_GPS_IN_DEGREES = 2
"""ver_data_format since PX4 1.14: positions of GPS receivers in degrees and metres."""


def information(vehicle: Vehicle, system_id: int, *, utc_boot_us: int, facts: Mapping[str, str]) -> list[bytes]:
    """The information messages.

    Args:
        vehicle: what is logged. system_id: its MAVLink system.
        utc_boot_us: UTC at vehicle time 0, us; 0 for unknown.
        facts: further texts by key; they win.
    """
    try:
        own = version("froude")
    except PackageNotFoundError:  # a source tree that was not installed
        own = "unknown"
    offset_min = int(vehicle.parameters.get("SDLOG_UTC_OFFSET")) if "SDLOG_UTC_OFFSET" in vehicle.parameters else 0
    texts = {
        "sys_name": "PX4",
        "ver_hw": "FROUDE_SITL",
        "ver_sw": f"froude-{own}",
        "ver_sw_branch": "simulation",
        "sys_os_name": "froude",
        "sys_uuid": f"froude-{system_id:03d}",
        "froude_version": own,
        "froude_vehicle": vehicle.model.name,
        "froude_profile": vehicle.profile.name,
        "froude_seed": str(vehicle.seed),
        **facts,
    }
    return [
        *(ulog.info(key, value) for key, value in texts.items()),
        ulog.info("ver_sw_release", PX4_VERSION),
        ulog.info("ver_data_format", _GPS_IN_DEGREES),
        ulog.info("time_ref_utc", min(max(offset_min, -1000), 1000) * 60, "int32_t"),
        *([ulog.info("boot_time_utc_us", utc_boot_us, "uint64_t")] if utc_boot_us else []),
    ]


def initial_parameters(table: ParameterTable) -> list[bytes]:
    """The defaults of the parameters that differ from them, then every value."""
    values, defaults = [], []
    for name in table:
        spec, raw = table.spec(name), table.raw(name)
        type_ = TYPES[spec.type]
        values.append(ulog.parameter(type_, name, raw))
        kinds: dict[bytes, int] = {}
        for kind, default in ((ulog.SYSTEM_DEFAULT, spec.default), (ulog.SETUP_DEFAULT, table.default(name))):
            stored = to_raw(name, spec.type, default)
            if stored != raw:
                kinds[stored] = kinds.get(stored, 0) | kind
        defaults += [ulog.parameter_default(type_, name, stored, kind) for stored, kind in kinds.items()]
    return defaults + values
