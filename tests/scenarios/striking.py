"""When to strike at a run: told by what its log holds, since how much it holds depends on how busy the computer is."""

from __future__ import annotations

import struct
from pathlib import Path

_STAMP, _VEHICLE, _ARMED, _OFFBOARD = 8, 1, 128, 6


def flown_heartbeats(log: Path) -> int:
    """How many heartbeats of an armed vehicle in Offboard a .tlog holds, also one that is still being written."""
    data, at, found = log.read_bytes(), _STAMP, 0
    while at + 10 < len(data):
        assert data[at] == 0xFD, f"{log}: no MAVLink 2 frame at byte {at}"
        size, signed = data[at + 1], data[at + 2] & 1
        payload = data[at + 10 : at + 10 + size]
        if data[at + 7 : at + 10] == b"\0\0\0" and data[at + 6] == _VEHICLE and len(payload) == 9:
            mode = struct.unpack_from("<I", payload)[0] >> 16 & 0xFF
            found += bool(payload[6] & _ARMED) and mode == _OFFBOARD
        at += 12 + size + 13 * signed + _STAMP
    return found


def flying(runs: Path, heartbeats: int = 3) -> Path | None:
    """The log of a flight, below the folder of all runs, that has been under way for so many seconds of its vehicle."""
    logs = (log for log in runs.glob("*/flights/*.partial.tlog") if flown_heartbeats(log) >= heartbeats)
    return next(logs, None)
