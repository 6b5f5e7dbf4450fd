"""Candidate commands of an experiment: smooth, within a band of frequencies, at rest at both ends."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np
from scipy.interpolate import BSpline

QUIET = 0.1  # share of an experiment at its end in which the machine comes to rest


def knot_times(seconds: float, band: float) -> np.ndarray:
    """Times, (k), at which commands of a band of frequencies, in Hz, are given; a spline is between them."""
    return np.linspace(0.0, seconds, max(8, round(2.0 * band * seconds) + 1))


def spline(knots: np.ndarray, seconds: float, steps: int) -> np.ndarray:
    """Commands of every control step, (steps, nu): a cubic B-spline with control points (k, nu), and between them."""
    inner = np.linspace(0.0, seconds, len(knots) - 2)
    return BSpline(np.pad(inner, 3, mode="edge"), knots, 3)(np.arange(steps) * seconds / steps)


def at_rest_at_both_ends(shape: np.ndarray) -> np.ndarray:
    """A shape (k, nu) that is 0 at its first knot and in its last ones, and otherwise at most 1."""
    quiet = max(4, round(QUIET * len(shape)))
    shape = shape.copy()
    shape[0] = shape[-quiet:] = 0.0
    largest = np.abs(shape).max()
    return shape / largest if largest > 0.0 else shape


def multisine(times: np.ndarray, nu: int, band: float, rng: np.random.Generator) -> np.ndarray:
    """Sum of the harmonics of the whole duration up to the band, with random phases and falling amplitudes."""
    harmonics = np.arange(1, max(2, int(band * times[-1])) + 1)
    amplitudes = harmonics ** -rng.uniform(0.0, 1.5) * rng.random((nu, len(harmonics)))
    phases = rng.uniform(0.0, 2.0 * np.pi, (nu, len(harmonics)))
    angle = 2.0 * np.pi * times[:, None, None] * harmonics / times[-1] + phases
    return (amplitudes * np.sin(angle)).sum(2)


def chirp(times: np.ndarray, nu: int, band: float, rng: np.random.Generator) -> np.ndarray:
    """Sine whose frequency grows to the band, one actuator after the other in phase."""
    first = rng.uniform(0.1, 0.3)
    phase = 2.0 * np.pi * (first * times + 0.5 * (band - first) * times**2 / times[-1])
    return np.sin(phase[:, None] + rng.uniform(0.0, 2.0 * np.pi, nu))


def steps(times: np.ndarray, nu: int, band: float, rng: np.random.Generator) -> np.ndarray:
    """Steps to random levels, each held for a random time."""
    shape, place = np.zeros((len(times), nu)), 0
    while place < len(times):
        held = max(2, round(rng.uniform(0.2, 1.2) / times[1]))
        shape[place : place + held] = rng.uniform(-1.0, 1.0, nu)
        place += held
    return shape


def ramps(times: np.ndarray, nu: int, band: float, rng: np.random.Generator) -> np.ndarray:
    """Slow ramps there and back."""
    period = times[-1] / rng.integers(1, 4)
    saw = 2.0 * np.abs(2.0 * ((times[:, None] / period + rng.random(nu)) % 1.0) - 1.0) - 1.0
    return saw * rng.uniform(0.3, 1.0, nu)


def swings(times: np.ndarray, nu: int, band: float, rng: np.random.Generator) -> np.ndarray:
    """Short pushes, each followed by a free swing."""
    shape, place = np.zeros((len(times), nu)), 1
    while place < len(times):
        push = max(1, round(rng.uniform(0.1, 0.4) / times[1]))
        shape[place : place + push] = rng.uniform(-1.0, 1.0, nu)
        place += push + max(2, round(rng.uniform(0.5, 1.5) / times[1]))
    return shape


Family = Callable[[np.ndarray, int, float, np.random.Generator], np.ndarray]
FAMILIES: Mapping[str, Family] = MappingProxyType(
    {"multisine": multisine, "chirp": chirp, "steps": steps, "ramps": ramps, "swings": swings}
)


def candidate(family: str, seconds: float, nu: int, band: float, rng: np.random.Generator) -> np.ndarray:
    """Knots of random commands of a family, (k, nu), between -1 and 1; some move a single actuator."""
    times = knot_times(seconds, band)
    shape = FAMILIES[family](times, nu, rng.uniform(0.3, 1.0) * band, rng)
    if nu > 1 and rng.random() < 0.3:
        shape[:, np.arange(nu) != rng.integers(nu)] *= rng.uniform(0.0, 0.3)
    return at_rest_at_both_ends(shape)
