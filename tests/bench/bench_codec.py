"""How fast messages are written and read, beside pymavlink in the same process.

Run: python -m pytest tests/bench/bench_codec.py -s. Figures are CPU time, best of five; only ratios are
asserted.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest
from pymavlink.dialects.v20 import common

from bridge.connection import Connection

pytestmark = pytest.mark.bench

COUNT = 10_000
LEAST_RATIO = 1.2

MESSAGES: dict[str, dict[str, Any]] = {
    "ATTITUDE": {
        "time_boot_ms": 40,
        "roll": 0.1,
        "pitch": 0.2,
        "yaw": 0.3,
        "rollspeed": 1.0,
        "pitchspeed": 2.0,
        "yawspeed": 3.0,
    },
    "PARAM_VALUE": {
        "param_id": b"MC_ROLLRATE_P",
        "param_value": 0.15,
        "param_type": 9,
        "param_count": 300,
        "param_index": 120,
    },
    "SET_ATTITUDE_TARGET": {
        "time_boot_ms": 40,
        "target_system": 1,
        "target_component": 1,
        "type_mask": 7,
        "q": (1.0, 0.0, 0.0, 0.0),
        "body_roll_rate": 0.0,
        "body_pitch_rate": 0.0,
        "body_yaw_rate": 0.0,
        "thrust": 0.5,
    },
}


def rates(*jobs: Callable[[], object]) -> list[float]:
    """Return how often each job runs in a second of CPU time.

    They take turns, so a busy machine hits all alike.
    """
    best = [0.0] * len(jobs)
    for _ in range(5):
        for index, job in enumerate(jobs):
            start = time.process_time()
            for _ in range(COUNT):
                job()
            best[index] = max(best[index], COUNT / (time.process_time() - start))
    return best


@pytest.mark.parametrize("name", MESSAGES)
def test_codec(name: str) -> None:
    fields = MESSAGES[name]
    ours = Connection(1, 1, datagram=True)
    reader = Connection(255, 190, datagram=True)
    mav = common.MAVLink(None, 1, 1)
    mav.robust_parsing = True
    definition = common.mavlink_map[getattr(common, f"MAVLINK_MSG_ID_{name}")]
    arguments = [fields[field] for field in definition.fieldnames]
    frame = ours.encode(name, **fields)
    field = definition.fieldnames[0]
    write, their_write, read, their_read = rates(
        lambda: ours.encode(name, **fields),
        lambda: definition(*arguments).pack(mav),
        lambda: getattr(reader.receive(frame)[0], field),
        lambda: getattr(mav.parse_buffer(frame)[0], field),
    )
    print(
        f"\n{name}: write {write / 1e3:.0f} k/s ({write / their_write:.1f} x pymavlink), "
        f"read {read / 1e3:.0f} k/s ({read / their_read:.1f} x)"
    )
    assert write / their_write > LEAST_RATIO
    assert read / their_read > LEAST_RATIO
