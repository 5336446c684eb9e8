"""What is wrong with a vehicle's body just now: gusts, motors, battery, gyro, the way from autopilot to motors.

Faults come and go while the plant moves. As long as none is in force plant and sensors do not even look here, so that a
flight without faults is the same to the last bit.

    faults = Faults(plant, sensors, seed=1)
    faults.begin(0, Gust(side_m_s2=1.5))
    ...
    faults.end(0)

Faults of one kind add up: forces and biases are summed, efficiencies multiplied, of several limits the lowest counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sitl.actuators import MAX_MOTORS
from sitl.plant import MAX_DELAY_TICKS, Plant
from sitl.sensors import Sensors

Floats = NDArray[np.float64]

AXES = {"roll": (0,), "pitch": (1,), "yaw": (2,), "all": (0, 1, 2)}
"""Axes of the gyro by name."""


@dataclass(frozen=True)
class Gust:
    """Air that pushes the vehicle to its right.

    Attributes:
        side_m_s2: force along the body's y axis per mass, m/s^2.
        roll_rad_s2: rolling moment per moment of inertia, rad/s^2.
        wind_m_s: air that moves along the body's y axis, m/s: it acts through Yv and Lv, as the vehicle's own speed
            the other way does.
    """

    side_m_s2: float = 0.0
    roll_rad_s2: float = 0.0
    wind_m_s: float = 0.0


@dataclass(frozen=True)
class MotorFault:
    """A motor that gives less thrust than it is told to.

    Attributes:
        motor: from 0; None for all.
        efficiency: share of the commanded thrust that it gives, 0 (it stands) to 1.
        most: share of its full thrust that it gives at most, 0 to 1.
    """

    motor: int | None = None
    efficiency: float = 1.0
    most: float = 1.0


@dataclass(frozen=True)
class BatterySag:
    """A battery whose voltage falls. A propeller's speed goes with it, its thrust with the square.

    Attributes:
        share: of the voltage that is missing, 0 to 1.
    """

    share: float


@dataclass(frozen=True)
class LoopDelay:
    """Motor commands that come later.

    Attributes:
        ticks: by so many.
    """

    ticks: int


@dataclass(frozen=True)
class GyroFault:
    """A gyro that does not tell the truth.

    Attributes:
        axes: 0 roll, 1 pitch, 2 yaw.
        bias_rad_s: added to the rate. noise_rad_s: standard deviation of what is added to each sample.
        lost: share of the samples that do not come; the last one stands. 1: it is stuck.
    """

    axes: tuple[int, ...] = AXES["all"]
    bias_rad_s: float = 0.0
    noise_rad_s: float = 0.0
    lost: float = 0.0


Effect = Gust | MotorFault | BatterySag | LoopDelay | GyroFault


class Faults:
    """The faults of one body.

    Args:
        plant: that moves. sensors: that measure it. seed: of what is left to chance.
    """

    def __init__(self, plant: Plant, sensors: Sensors, seed: int) -> None:
        self._plant = plant
        self._sensors = sensors
        self._seed = seed
        self._delay_ticks = int(plant.settings["delay_ticks"][0])
        self._effects: dict[int, Effect] = {}
        self._rngs: dict[int, np.random.Generator] = {}
        self.voltage = 1.0
        """Share of its voltage that the battery has."""

    def begin(self, number: int, effect: Effect) -> None:
        """Put a fault in force.

        Args:
            number: of the fault; what it leaves to chance depends on this, the seed and the tick alone.
            effect: what it does.
        """
        self._effects[number] = effect
        self._rngs[number] = np.random.default_rng([self._seed, 3, number])
        self._apply()

    def end(self, number: int) -> None:
        """Take a fault away; a number that is not in force is ignored."""
        self._effects.pop(number, None)
        self._rngs.pop(number, None)
        self._apply()

    def _apply(self) -> None:
        effects = list(self._effects.values())
        self._push([one for one in effects if isinstance(one, Gust)])
        sags = [1.0 - one.share for one in effects if isinstance(one, BatterySag)]
        self.voltage = math.prod(sags, start=1.0)
        self._weaken([one for one in effects if isinstance(one, MotorFault)])
        extra = sum(one.ticks for one in effects if isinstance(one, LoopDelay))
        self._plant.set_delay(min(MAX_DELAY_TICKS, self._delay_ticks + extra))
        gyro = [(one, self._rngs[n]) for n, one in self._effects.items() if isinstance(one, GyroFault)]
        self._sensors.gyro_fault = _GyroError(gyro) if gyro else None

    def _push(self, gusts: list[Gust]) -> None:
        settings = self._plant.settings[0]
        side = roll = 0.0
        for gust in gusts:
            side += gust.side_m_s2 - float(settings["Yv"]) * gust.wind_m_s
            roll += gust.roll_rad_s2 - float(settings["Lv"]) * gust.wind_m_s
        settings["gust_m_s2"], settings["gust_rad_s2"] = side, roll
        settings["gusts"] = bool(gusts)

    def _weaken(self, faults: list[MotorFault]) -> None:
        if not faults and self.voltage == 1.0:
            self._plant.weaken = None
            return
        efficiency, most = np.full(MAX_MOTORS, self.voltage**2), np.ones(MAX_MOTORS)
        for fault in faults:
            motors = slice(None) if fault.motor is None else fault.motor
            efficiency[motors] *= fault.efficiency
            most[motors] = np.minimum(most[motors], fault.most)
        self._plant.weaken = lambda commands: np.minimum(commands * efficiency, most)


class _GyroError:
    """What all gyro faults in force make of a sample."""

    def __init__(self, faults: list[tuple[GyroFault, np.random.Generator]]) -> None:
        self._faults = faults

    def added(self) -> Floats:
        """(3,) what is added to the true rates in this sample, rad/s."""
        error = np.zeros(3)
        for fault, rng in self._faults:
            axes = list(fault.axes)
            error[axes] += fault.bias_rad_s
            if fault.noise_rad_s:
                error[axes] += fault.noise_rad_s * rng.standard_normal(len(axes))
        return error

    def lost(self) -> NDArray[np.bool_]:
        """(3,) True where this sample does not come."""
        lost = np.zeros(3, dtype=bool)
        for fault, rng in self._faults:
            if fault.lost and (fault.lost >= 1.0 or rng.random() < fault.lost):
                lost[list(fault.axes)] = True
        return lost
