"""Which of ArduPilot's frames an airframe is, and which of its outputs drives which rotor.

ArduPilot knows a frame by the angle and the turn of every motor, PX4 by its place in metres. They number motors
differently, so a rotor is looked for where ArduPilot's motor stands and turns the same way. Both mixes are normalised,
each in its own way: the factor between them is computed here.

Source: ArduPilot ``AP_MotorsMatrix`` (frames, mix), parameters FRAME_CLASS and FRAME_TYPE.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sitl.actuators import PITCH, ROLL, THRUST, YAW, Mix
from sitl.airframe import Rotor
from sitl.errors import UsageError

CCW, CW = 1, -1
_NEAR = 0.45
"""How far from its frame's angle a rotor may stand, in parts of the angle between two arms: below half of it."""

_COUPLING = 0.1
"""Torque about another axis, in parts of the one that was asked for, above which the frame's mix does not fit."""


@dataclass(frozen=True)
class ArduPilotFrame:
    """One frame.

    Attributes:
        name: for people. frame_class, frame_type: parameters FRAME_CLASS and FRAME_TYPE.
        motors: (angle clockwise from the nose seen from above, deg; CCW or CW) of motors 1, 2, ...
    """

    name: str
    frame_class: int
    frame_type: int
    motors: tuple[tuple[float, int], ...]


def _ring(*angles_deg: float, turns: Sequence[int]) -> tuple[tuple[float, int], ...]:
    return tuple(zip(angles_deg, turns, strict=True))


_X = (45.0, -135.0, -45.0, 135.0)
_PLUS = (90.0, -90.0, 0.0, 180.0)
_OCTA_X = (22.5, -157.5, 67.5, 157.5, -22.5, -112.5, -67.5, 112.5)
_OCTA_PLUS = (0.0, 180.0, 45.0, 135.0, -45.0, -135.0, -90.0, 90.0)
_COAXIAL_X = (45.0, -45.0, -135.0, 135.0, -45.0, 45.0, 135.0, -135.0)
_COAXIAL_PLUS = (0.0, -90.0, 180.0, 90.0, -90.0, 0.0, 90.0, 180.0)
_PAIRS = (CCW, CCW, CW, CW)
_FOURS = (CW, CW, CCW, CCW, CCW, CCW, CW, CW)
_TURNS = (CCW, CW) * 4

FRAMES = (
    ArduPilotFrame("quad X", 1, 1, _ring(*_X, turns=_PAIRS)),
    ArduPilotFrame("quad H (an X with its motors reversed)", 1, 3, _ring(*_X, turns=[-one for one in _PAIRS])),
    ArduPilotFrame("quad plus", 1, 0, _ring(*_PLUS, turns=_PAIRS)),
    ArduPilotFrame("hexa X", 2, 1, _ring(90.0, -90.0, -30.0, 150.0, 30.0, -150.0, turns=(CW, CCW, CW, CCW, CCW, CW))),
    ArduPilotFrame("hexa plus", 2, 0, _ring(0.0, 180.0, -120.0, 60.0, -60.0, 120.0, turns=(CW, CCW, CW, CCW, CCW, CW))),
    ArduPilotFrame("octa X", 3, 1, _ring(*_OCTA_X, turns=_FOURS)),
    ArduPilotFrame("octa plus", 3, 0, _ring(*_OCTA_PLUS, turns=_FOURS)),
    ArduPilotFrame("octa DJI X", 3, 13, _ring(22.5, -22.5, -67.5, -112.5, -157.5, 157.5, 112.5, 67.5, turns=_TURNS)),
    ArduPilotFrame("octaquad X", 4, 1, _ring(*_COAXIAL_X, turns=_TURNS)),
    ArduPilotFrame("octaquad H (an X with its motors reversed)", 4, 3, _ring(*_COAXIAL_X, turns=_TURNS[::-1])),
    ArduPilotFrame("octaquad plus", 4, 0, _ring(*_COAXIAL_PLUS, turns=_TURNS)),
)
"""What ArduPilot has for the layouts that fly here."""


@dataclass(frozen=True)
class FrameFit:
    """An airframe as ArduPilot flies it.

    Attributes:
        frame: ArduPilot's.
        order: (n,) rotor, in PX4's numbering from 0, of each of ArduPilot's outputs.
        off_deg: largest angle between a rotor and where ArduPilot takes it to be.
        roll, pitch, yaw: delta_lat, delta_lon, delta_yaw per unit of ArduPilot's command while nothing saturates and
            thrust is linear.
    """

    frame: ArduPilotFrame
    order: tuple[int, ...]
    off_deg: float
    roll: float
    pitch: float
    yaw: float


def fit_frame(name: str, rotors: Sequence[Rotor], mix: Mix) -> FrameFit:
    """The ArduPilot frame of an airframe, the nearest if there are several.

    Args:
        name: of the airframe, for the message. rotors: in PX4's order. mix: PX4's of these rotors.

    Raises:
        UsageError: none has these rotors.
    """
    fits = [fit for frame in FRAMES if (fit := _fit(frame, rotors, mix)) is not None]
    if not fits:
        raise UsageError(
            f"{name}: ArduPilot has no frame with its rotors ({_described(rotors)}). It knows "
            f"{', '.join(frame.name for frame in FRAMES if len(frame.motors) == len(rotors)) or 'no such number'}, "
            "arms evenly spread; fly it with PX4 (--link tcpin://127.0.0.1:4560), which takes any geometry"
        )
    return min(fits, key=lambda fit: fit.off_deg)


def ardupilot_mix(frame: ArduPilotFrame) -> NDArray[np.float64]:
    """What ArduPilot adds to each motor per unit of command.

    Args:
        frame: which.

    Returns:
        (n, 4) roll, pitch, yaw, thrust in ArduPilot's motor order; the largest of roll, pitch and yaw is 0.5.
    """
    angles = np.radians([angle for angle, _ in frame.motors])
    turns = np.array([turn for _, turn in frame.motors], dtype=float)
    columns = np.column_stack([-np.sin(angles), np.cos(angles), turns, np.ones(len(angles))])
    columns[:, :THRUST] *= 0.5 / np.abs(columns[:, :THRUST]).max(axis=0)
    return columns


def _fit(frame: ArduPilotFrame, rotors: Sequence[Rotor], mix: Mix) -> FrameFit | None:
    if len(frame.motors) != len(rotors):
        return None
    angles = [_angle_deg(rotor) for rotor in rotors]
    near_deg = _NEAR * 360.0 / len({angle for angle, _ in frame.motors})
    order: list[int] = []
    off_deg = 0.0
    for angle, turn in frame.motors:
        free = [i for i, rotor in enumerate(rotors) if i not in order and rotor.km * turn > 0.0]
        if not free:
            return None
        nearest = min(free, key=lambda i: _apart_deg(angles[i], angle))
        off_deg = max(off_deg, _apart_deg(angles[nearest], angle))
        order.append(nearest)
    if off_deg > near_deg:
        return None
    # row k of `given` is what a unit of ArduPilot's command of axis k gives in PX4's axes
    given = (mix.inverse[:, order] @ ardupilot_mix(frame)).T
    own = np.diag(given)
    if (own <= 0.0).any() or (np.abs(given - np.diag(own)) > _COUPLING * own[:, None]).any():
        return None
    return FrameFit(frame, tuple(order), off_deg, *(float(own[axis]) for axis in (ROLL, PITCH, YAW)))


def _angle_deg(rotor: Rotor) -> float:
    return math.degrees(math.atan2(rotor.py_m, rotor.px_m))


def _apart_deg(one: float, other: float) -> float:
    return abs((one - other + 180.0) % 360.0 - 180.0)


def _described(rotors: Sequence[Rotor]) -> str:
    return ", ".join(f"{_angle_deg(rotor):.0f} deg {'ccw' if rotor.km > 0.0 else 'cw'}" for rotor in rotors)
