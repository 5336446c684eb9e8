"""The vehicle in space: body, rotors and path in the viewer's east-north-up world.

PX4's frames have z down (north-east-down, forward-right-down); here everything is turned over once.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from scenarios.recorder.stream import Colour, Recording

STRIDE = 4
"""Every so many rows the vehicle is placed: more often than a screen shows."""
PATH_STRIDE = 6
"""Every so many of these a corner of the path."""
PLACE = "/world/place"
"""Where the vehicle is, without its attitude: seen from here it is in the middle, the horizon level."""
BODY = PLACE + "/body"
GROUND_M = 30
"""Half the side of the drawn ground, squares of 1 m."""
ROTOR_DIAGONALS = 0.2
"""Radius of a rotor, in diagonals of the frame: an airframe's file has no propellers. Less where they would touch."""
BODY_SHARE = 0.3
"""Drawn length and width of the body without arms, in those of the frame."""
ARROW_DIAGONALS = 0.7
"""Length of a full-thrust arrow, in diagonals of the frame."""


class RotorPlace(Protocol):
    """What is needed of a rotor: its hub in the body (forward, right, down), m, and its moment ratio."""

    @property
    def px_m(self) -> float: ...  # noqa: D102
    @property
    def py_m(self) -> float: ...  # noqa: D102
    @property
    def pz_m(self) -> float: ...  # noqa: D102
    @property
    def km(self) -> float: ...  # noqa: D102


class BodyView:
    """Draws one vehicle into a recording.

    Args:
        recording: where to.
        rotors: at least one, in motor order.
        colours: one per motor, the same as in the motors' plot.
        frame_m: length, width, height of the body, m; zeros if not known.
    """

    def __init__(
        self,
        recording: Recording,
        rotors: Sequence[RotorPlace],
        colours: Sequence[Colour],
        frame_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        import rerun as rr

        self._recording = recording
        self._corners: list[NDArray[np.float64]] = []
        hubs = np.array([(rotor.px_m, -rotor.py_m, -rotor.pz_m) for rotor in rotors])
        diagonal = 2.0 * float(np.max(np.hypot(hubs[:, 0], hubs[:, 1]))) or 1.0
        self._arrow_m = ARROW_DIAGONALS * diagonal
        grey = (150, 150, 150)
        recording.log("/world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        recording.log("/world/ground", _ground())
        recording.log(
            f"{BODY}/arms",
            rr.LineStrips3D([[(0.0, 0.0, 0.0), tuple(hub)] for hub in hubs], radii=0.02 * diagonal, colors=[grey]),
        )
        recording.log(
            f"{BODY}/rotors",
            rr.Cylinders3D(
                lengths=[0.02 * diagonal] * len(hubs),
                radii=[rotor_radius(hubs, diagonal)] * len(hubs),
                centers=hubs,
                labels=[f"{n + 1}" for n in range(len(hubs))],
                show_labels=True,
                colors=list(colours),
                fill_mode="solid",
            ),
        )
        if min(frame_m) > 0.0:
            # as wide as the arms leave room for: the frame's own length and width reach to the motors
            half = [0.5 * frame_m[0] * BODY_SHARE, 0.5 * frame_m[1] * BODY_SHARE, 0.25 * frame_m[2]]
            recording.log(f"{BODY}/frame", rr.Boxes3D(half_sizes=[half], colors=[(105, 105, 105)], fill_mode="solid"))
        recording.log(
            f"{BODY}/front",
            rr.Arrows3D(
                vectors=[(0.45 * diagonal, 0.0, 0.0)],
                colors=[(235, 235, 235)],
                radii=0.02 * diagonal,
            ),
        )
        recording.log(
            f"{BODY}/thrust",
            rr.Arrows3D.from_fields(origins=hubs, colors=list(colours), radii=0.015 * diagonal),
        )

    def rows(
        self,
        time_s: NDArray[np.float64],
        columns: Mapping[str, NDArray[Any]],
        enu_m: NDArray[np.float64],
        motors: NDArray[np.float64],
    ) -> None:
        """Move the body.

        Args:
            time_s: (n,) on the timeline.
            columns: telemetry with `phi_rad`, `theta_rad`, `psi_rad`.
            enu_m: (n, 3) position east, north, up.
            motors: (n, rotors) commands 0 to 1, drawn as arrows.
        """
        import rerun as rr

        recording = self._recording
        # the last row always: what follows may be far away in time
        shown = np.unique(np.append(np.arange(0, len(time_s), STRIDE), len(time_s) - 1))
        time_s, enu_m, motors = time_s[shown], enu_m[shown], motors[shown]
        columns = {name: columns[name][shown] for name in ("phi_rad", "theta_rad", "psi_rad")}
        quat = enu_quaternions(columns["phi_rad"], columns["theta_rad"], columns["psi_rad"])
        recording.columns(PLACE, time_s, rr.Transform3D.columns(translation=enu_m))
        recording.columns(BODY, time_s, rr.Transform3D.columns(quaternion=quat[:, (1, 2, 3, 0)]))
        arrows = np.zeros((*motors.shape, 3))
        arrows[:, :, 2] = np.nan_to_num(motors) * self._arrow_m
        thrust = rr.Arrows3D.columns(vectors=arrows.reshape(-1, 3)).partition(np.full(len(time_s), motors.shape[1]))
        recording.columns(f"{BODY}/thrust", time_s, thrust)
        self._corners.extend(enu_m[::PATH_STRIDE])
        path = rr.LineStrips3D([np.array(self._corners)], colors=[(86, 180, 233)], radii=[-1.5])
        recording.log("/world/path", path, float(time_s[0]))


@cache
def _ground() -> Any:
    """The same for every flight."""
    import rerun as rr

    edge = float(GROUND_M)
    across = [[(-edge, float(y), 0.0), (edge, float(y), 0.0)] for y in range(-GROUND_M, GROUND_M + 1)]
    along = [[(x, y, z) for y, x, z in line] for line in across]
    return rr.LineStrips3D([*across, *along], radii=-0.5, colors=[(70, 70, 70)])


def rotor_radius(hubs: NDArray[np.float64], diagonal_m: float) -> float:
    """Radius to draw rotors with, m: neighbours beside each other do not touch; those above each other do not count.

    Args:
        hubs: (n, 3) places. diagonal_m: of the frame.
    """
    apart = np.hypot(*(hubs[:, None, :2] - hubs[None, :, :2]).transpose(2, 0, 1))
    beside = apart[apart > 0.05 * diagonal_m]
    return (
        float(min(ROTOR_DIAGONALS * diagonal_m, 0.47 * beside.min())) if beside.size else ROTOR_DIAGONALS * diagonal_m
    )


def enu_quaternions(phi: NDArray[Any], theta: NDArray[Any], psi: NDArray[Any]) -> NDArray[np.float64]:
    """Attitude of the body (forward-left-up) in the world (east-north-up).

    Args:
        phi: (n,) roll, rad, of the body (forward-right-down) in north-east-down.
        theta: (n,) pitch, rad.
        psi: (n,) heading, rad.

    Returns:
        (n, 4) quaternions, w x y z.
    """
    # Turning both frames over keeps roll, mirrors pitch, and counts heading anticlockwise from east.
    half_roll = 0.5 * np.asarray(phi, dtype=np.float64)
    half_pitch = -0.5 * np.asarray(theta, dtype=np.float64)
    half_yaw = 0.5 * (0.5 * math.pi - np.asarray(psi, dtype=np.float64))
    cr, sr = np.cos(half_roll), np.sin(half_roll)
    cp, sp = np.cos(half_pitch), np.sin(half_pitch)
    cy, sy = np.cos(half_yaw), np.sin(half_yaw)
    return np.column_stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )
