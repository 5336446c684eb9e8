"""The message definitions on the wire: pymavlink's `common` with our additions over it.

Only this package imports pymavlink. Its bundled `common` follows ArduPilot's branch: it lacks messages PX4
sends and carries some without their newest extension fields. `froude.xml` holds those; README.md here says
how it becomes `froude_messages.py`.
"""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import common

from bridge.dialect import froude_messages as ours


def message_classes() -> dict[int, Any]:
    """Return the generated message class of every id; ours stands before pymavlink's."""
    return {**common.mavlink_map, **ours.mavlink_map}
