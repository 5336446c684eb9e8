"""Pieces of a roll set-point signal: straight lines, sines and chirps, as pure functions of local time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


class Part(Protocol):
    """A piece of a signal; local time runs from 0 to `duration_s`."""

    @property
    def duration_s(self) -> float:
        """Length of the piece."""

    def values(self, t_s: FloatArray) -> FloatArray:
        """Roll set-point in rad at local times, shape of t_s."""


@dataclass(frozen=True)
class Ramp:
    """A straight line from one roll angle to another."""

    duration_s: float
    from_rad: float
    to_rad: float

    @classmethod
    def level(cls, duration_s: float, phi_deg: float) -> Ramp:
        """One roll angle, held."""
        return cls(duration_s, math.radians(phi_deg), math.radians(phi_deg))

    @classmethod
    def at_rate(cls, from_deg: float, to_deg: float, rate_deg_s: float) -> Ramp:
        """From one angle to another at a given rate."""
        return cls(abs(to_deg - from_deg) / rate_deg_s, math.radians(from_deg), math.radians(to_deg))

    def values(self, t_s: FloatArray) -> FloatArray:
        """Roll set-point in rad at local times."""
        return self.from_rad + (self.to_rad - self.from_rad) * (t_s / self.duration_s)


@dataclass(frozen=True)
class Sines:
    """Sines of equal amplitude, faded in and out linearly."""

    duration_s: float
    amplitude_rad: float
    frequencies_hz: tuple[float, ...]
    phases_rad: tuple[float, ...]
    fade_s: float

    @classmethod
    def with_peak(
        cls,
        duration_s: float,
        peak_deg: float,
        frequencies_hz: tuple[float, ...],
        phases_rad: tuple[float, ...],
        fade_s: float,
        rate_hz: float,
    ) -> Sines:
        """Scaled so that the largest magnitude among the set-points sent at `rate_hz` is the peak."""
        unit = cls(duration_s, 1.0, frequencies_hz, phases_rad, fade_s)
        sent = unit.values(np.arange(round(duration_s * rate_hz)) / rate_hz)
        return cls(duration_s, math.radians(peak_deg) / float(np.abs(sent).max()), frequencies_hz, phases_rad, fade_s)

    def values(self, t_s: FloatArray) -> FloatArray:
        """Roll set-point in rad at local times."""
        angles = 2 * math.pi * np.multiply.outer(t_s, self.frequencies_hz) + np.asarray(self.phases_rad)
        faded = self.amplitude_rad * _fade(t_s, self.duration_s, self.fade_s)
        return np.asarray(faded * np.sin(angles).sum(axis=-1))


@dataclass(frozen=True)
class Chirp:
    """A sine whose frequency sweeps from f0 to f1, linearly or logarithmically in time, faded in and out."""

    duration_s: float
    amplitude_rad: float
    f0_hz: float
    f1_hz: float
    logarithmic: bool
    fade_s: float

    def values(self, t_s: FloatArray) -> FloatArray:
        """Roll set-point in rad at local times."""
        if self.logarithmic and self.f0_hz != self.f1_hz:
            growth = math.log(self.f1_hz / self.f0_hz) / self.duration_s
            cycles = self.f0_hz * np.expm1(growth * t_s) / growth
        else:
            cycles = self.f0_hz * t_s + 0.5 * (self.f1_hz - self.f0_hz) / self.duration_s * t_s**2
        faded = self.amplitude_rad * _fade(t_s, self.duration_s, self.fade_s)
        return np.asarray(faded * np.sin(2 * math.pi * cycles))


def _fade(t_s: FloatArray, duration_s: float, fade_s: float) -> FloatArray:
    if fade_s <= 0:
        return np.ones_like(t_s)
    return np.clip(np.minimum(t_s, duration_s - t_s) / fade_s, 0.0, 1.0)
