"""When to strike at a run: told by what its log holds, since how much it holds depends on how busy the computer is."""

from __future__ import annotations

from pathlib import Path

from bridge.connection import Connection
from bridge.messages import BY_NAME
from bridge.px4_modes import ARMED, PX4_MODES
from bridge.tlog import whole_frames
from sitl.modes import Mode

OFFBOARD = PX4_MODES[Mode.OFFBOARD].custom_mode
HEARTBEAT = BY_NAME["HEARTBEAT"].id.to_bytes(3, "little")


def flown_heartbeats(log: Path) -> int:
    """How many heartbeats of an armed vehicle in Offboard a .tlog holds, also one that is still being written."""
    data, reader = log.read_bytes(), Connection(255, 190)
    frames = (data[begin:end] for _, begin, end in whole_frames(data) if data[begin + 7 : begin + 10] == HEARTBEAT)
    beats = (message for frame in frames for message in reader.receive(frame))
    return sum(beat.custom_mode == OFFBOARD and bool(beat.base_mode & ARMED) for beat in beats)


def flying(runs: Path, heartbeats: int = 3) -> Path | None:
    """The log of a flight, below the folder of all runs, that has been under way for so many seconds of its vehicle."""
    logs = (log for log in runs.glob("*/flights/*.partial.tlog") if flown_heartbeats(log) >= heartbeats)
    return next(logs, None)
