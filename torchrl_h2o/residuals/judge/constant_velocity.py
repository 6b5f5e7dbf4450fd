"""Whether effects explain the motion, or only keep the joints from moving."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from torchrl_h2o.effects import Effect, selection
from torchrl_h2o.residuals.judge.headline import VELOCITY_UNITS
from torchrl_h2o.residuals.measured.constant_velocity import explains_motion, median_errors, shares_of_guess
from torchrl_h2o.residuals.measured.transitions import Measured, Split
from torchrl_h2o.residuals.report.words import duration, effect_words, quantity
from torchrl_h2o.residuals.settings import DEFAULTS, LoopSettings
from torchrl_h2o.residuals.simulation.simulation import Simulation


def no_better_than_constant_velocity(
    mended: Simulation, measured: Measured, effects: Sequence[Effect], settings: LoopSettings = DEFAULTS
) -> tuple[str, ...]:
    """Says so if effects predict motion no better than the guess that every velocity stays as it is.

    Rotors so heavy that no torque moves them lower the error of a model without friction, if the motion is slow. Such
    effects explain nothing: they predict that the velocities do not change.

    Args:
        mended: the simulator with the effects found.
        measured: the data, of which the part for the report is used.
        effects: the effects; each is judged by the joints that it acts on.
        settings: times ahead, and the share of the guess's error up to which a prediction counts as better.

    Returns:
        One clause if most quantities are predicted no better at any time ahead. Otherwise one for each effect on
        joints all of whose quantities are predicted no better.
    """
    rules, seconds = settings.judge, settings.judge.headline_seconds
    shares = shares_of_guess(mended, measured, Split.REPORT, seconds, rules.headline_windows)
    most = settings.verdict.better_than_guess
    if not shares:
        return ()
    if not explains_motion(shares, most):
        everything = range(len(mended.state_map.names))
        return (f"they predict the motion {_hardly_better(mended, measured, shares, everything)}",)
    clauses = []
    for effect in effects:
        own = _quantities_of_joints(mended, effect)
        if own and min(float(share[own].min()) for share in shares.values()) > most:
            joints = f"with {effect_words(effect)}, the motion of these joints is predicted"
            clauses.append(f"{joints} {_hardly_better(mended, measured, shares, own)}")
    return tuple(clauses)


def _hardly_better(
    mended: Simulation, measured: Measured, shares: Mapping[int, np.ndarray], among: Sequence[int]
) -> str:
    """The end of a clause, with the errors of a usual one of these quantities."""
    steps, share = min(shares.items())
    names, units = mended.state_map.names, mended.state_map.units
    # a position is easier to picture than a velocity
    usual = np.median(share[among])
    index = min(among, key=lambda i: (units[i] in VELOCITY_UNITS, abs(share[i] - usual)))
    errors = median_errors(mended, measured, measured.reported_on(steps), steps)
    missed, guessed = (quantity(float(error[index]), units[index], 2) for error in errors)
    ahead = f"{names[index]} {duration(steps * mended.control_step)} ahead"
    return f"hardly better than by the guess that every velocity stays as it is ({ahead}: {missed} against {guessed})"


def _quantities_of_joints(simulation: Simulation, effect: Effect) -> list[int]:
    """Indices of the quantities that observe the joints of an effect; empty if it does not act on joints."""
    if (chosen := getattr(effect, "joints", None)) is None:
        return []
    model, observe = simulation.model, simulation.state_map.observe
    coordinates: list[int] = []
    for joint in selection.joints(simulation.spec(), chosen):
        at = model.joint(joint.name)
        coordinates += range(at.qposadr[0], at.qposadr[0] + len(at.qpos0))
        coordinates += range(model.nq + at.dofadr[0], model.nq + at.dofadr[0] + len(at.damping))
    return [int(i) for i in np.flatnonzero((observe[:, coordinates] != 0.0).any(1))]
