"""Proposes effects from a regression of the forces that the simulator lacks along the measured motion.

Where friction takes most of a motor's torque, a simulator without friction runs away within a few control steps. Its
error is then far from linear in the effects, and a rotor so heavy that nothing moves lowers it more than any single
right effect does. The force that is missing at the measured positions, velocities and accelerations is nearly linear
in the effects, so a regression finds all of them together, as in the identification of robot arms: Atkeson, An and
Hollerbach (1986), Estimation of Inertial Parameters of Manipulator Loads and Links, International Journal of Robotics
Research 5(3), 101-119.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.stats import t as student_t

from torchrl_h2o.effects import (
    Armature,
    BodyMass,
    CatalogueEntry,
    Effect,
    JointDamping,
    JointForce,
    JointFrictionLoss,
    JointSpring,
    Payload,
    selection,
)
from torchrl_h2o.residuals.measured.missing_force import Motion, measured_motion, missing_force
from torchrl_h2o.residuals.measured.transitions import Measured, Split
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.trace.families import elements
from torchrl_h2o.residuals.trace.force_regression import ForceRegression, robust_losses, usual_size
from torchrl_h2o.residuals.trace.model_bounds import lowest_value

ROUNDS = 3  # repetitions of the regression around the values found, because dry friction is soft in MuJoCo
SAME_VALUE = 0.01  # change of all values, as a share, up to which the regression is not repeated any more
BLOCKS = 20  # blocks of neighbouring windows by which intervals are computed
MORE_LEFT = 1.2  # multiple of the mean loss with all entries up to which entries are left out
MORE_LEFT_OF_ONE = 1.5  # the same for the force at each coordinate alone

#: the properties of links and joints that are identified; the gain of a motor is not among them, because with a gain of
#: zero and masses of zero no force would be missing
PROPOSED = (JointFrictionLoss, JointDamping, JointSpring, JointForce, Armature, BodyMass, Payload)

_HEAVY = 1e3  # inertia of a rotor beside which friction is dry, in inertias of its joint
_ALIKE = 1.0 - 1e-9  # cosine of two changes of the force from which they are the same
_NO_SHARE = 1e-6  # share of a trial below which an effect is none


@dataclass(frozen=True)
class Proposal:
    """Effects at the values of a regression.

    Args:
        entries: entries of the catalogue.
        effects: each entry's effect.
        half_widths: half-width of the 95 % interval of each parameter that the regression moves, by effect and name, in
            its unit; from a jackknife over blocks of the data.
    """

    entries: tuple[CatalogueEntry, ...] = ()
    effects: tuple[Effect, ...] = ()
    half_widths: tuple[dict[str, float], ...] = ()


def propose_effects(
    simulation: Simulation,
    measured: Measured,
    catalogue: Sequence[CatalogueEntry],
    advance: Callable[[], object] = lambda: None,
) -> Proposal:
    """The properties of single links and joints that together explain the missing force.

    All are fitted together, and then left out one by one, the one that is needed least first; at the end also those
    whose 95 % interval contains the value without effect. Accelerations are means over windows of twice ``half_width``.

    Args:
        simulation: the simulator.
        measured: the data, of which the part for fits is used.
        catalogue: effects that the simulator may lack.
        advance: called after each entry.

    Returns:
        The effects; none if coordinates are unobserved, if actuators have a state of their own, which is not measured,
        if the rows are too few, or if the model rejects them together.
    """
    motion = measured_motion(simulation, measured, Split.FIT)
    if motion is None:
        return Proposal()
    missing = missing_force(simulation, motion)
    entries, columns = [], []
    for entry in catalogue:
        if isinstance(entry.effect, PROPOSED) and _acts_on_one(entry.effect, simulation):
            change = _change(simulation, motion, missing, entry)
            if change is not None:
                entries.append(entry)
                columns.append(change)
        advance()
    if not entries:
        return Proposal()
    bounds, changes = np.array([_bounds(entry, simulation.model) for entry in entries]).T, np.stack(columns, axis=-1)
    shares = _simplest(_needed(missing, changes, bounds), changes, bounds, entries)
    kept = np.flatnonzero(shares)
    while len(kept):
        chosen = [entries[index] for index in kept]
        try:
            at = _repeated(simulation, motion, chosen, shares[kept], bounds[:, kept], advance)
            sure, half_widths = _sure(at, bounds[:, kept], BLOCKS, advance)
        except ValueError:  # the model rejects the values together, or they leave no finite force
            break
        shares[kept] = at.shares
        if len(sure) == len(kept):
            return _proposal(chosen, at.shares, half_widths, simulation.model)
        kept = kept[sure]
    return Proposal()


def _proposal(
    entries: Sequence[CatalogueEntry], shares: np.ndarray, half_widths: np.ndarray, model: mujoco.MjModel
) -> Proposal:
    """The effects at shares of their trials, with the half-widths of these shares."""
    return Proposal(
        tuple(entries),
        tuple(_at(entry, share, model) for entry, share in zip(entries, shares, strict=True)),
        tuple(
            {name: float(width * abs(_step(entry, name))) for name in _scaled(entry)}
            for entry, width in zip(entries, half_widths, strict=True)
        ),
    )


@dataclass(frozen=True, eq=False)
class _Linearised:
    """The missing force beside effects at ``shares``, (P), of their trials: (W, nv), and its change with each share."""

    shares: np.ndarray
    missing: np.ndarray
    changes: np.ndarray


def _linearised(
    simulation: Simulation,
    motion: Motion,
    entries: Sequence[CatalogueEntry],
    shares: np.ndarray,
    bounds: np.ndarray,
) -> _Linearised:
    """The force beside effects at shares, and its change by steps of 5 % of each share, within the bounds.

    Raises:
        ValueError: if the model rejects the effects together, or a force that is known without them is not finite.
    """

    def force(at: np.ndarray) -> np.ndarray:
        effects = (_at(entry, share, simulation.model) for entry, share in zip(entries, at, strict=True))
        left = _missing_force_with(simulation, effects, motion)
        if not np.isfinite(left[motion.moving]).all():
            raise ValueError("the missing force is not finite")
        return left

    lengths = 0.05 * np.where(np.abs(shares) < _NO_SHARE, 1.0, shares)
    outside = (shares + lengths < bounds[0]) | (shares + lengths > bounds[1])
    lengths = np.where(outside, -lengths, lengths)
    here = force(shares)
    changes = [(force(shares + step) - here) / length for step, length in zip(np.diag(lengths), lengths, strict=True)]
    return _Linearised(shares, here, np.stack(changes, axis=-1))


def _repeated(
    simulation: Simulation,
    motion: Motion,
    entries: Sequence[CatalogueEntry],
    shares: np.ndarray,
    bounds: np.ndarray,
    advance: Callable[[], object],
) -> _Linearised:
    """Regressions, each around the values of the one before, until no less force is missing or no value changes."""
    at = _linearised(simulation, motion, entries, shares, bounds)
    scale = usual_size(at.missing)
    for _ in range(ROUNDS):
        advance()
        moved_by = ForceRegression.fit(at.missing, at.changes, bounds - at.shares).shares
        moved = _linearised(simulation, motion, entries, at.shares + moved_by, bounds)
        if np.nanmean(robust_losses(moved.missing, scale)) >= np.nanmean(robust_losses(at.missing, scale)):
            break
        at = moved
        if (np.abs(moved_by) <= SAME_VALUE * np.abs(at.shares)).all():
            break
    return at


def _sure(
    at: _Linearised, bounds: np.ndarray, blocks: int, advance: Callable[[], object]
) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the effects that stay after the least certain one has been left out again and again.

    This ends when no 95 % interval contains the value without effect. Also returns the intervals' half-widths.
    """
    kept, shares, missing = np.arange(len(at.shares)), at.shares.copy(), at.missing
    while len(kept):
        advance()
        half_widths = _half_widths(missing, at.changes[..., kept], bounds[:, kept] - shares[kept], blocks)
        size = np.abs(shares[kept])
        doubt = np.where(size < _NO_SHARE, np.inf, half_widths / np.maximum(size, _NO_SHARE))
        if doubt.max() <= 1.0:
            return kept, half_widths
        out = kept[doubt.argmax()]
        kept, missing = np.delete(kept, doubt.argmax()), missing - shares[out] * at.changes[..., out]
        if len(kept):
            moved_by = ForceRegression.fit(missing, at.changes[..., kept], bounds[:, kept] - shares[kept]).shares
            shares[kept] += moved_by
            missing = missing + at.changes[..., kept] @ moved_by
    return kept, np.zeros(0)


def _half_widths(missing: np.ndarray, changes: np.ndarray, bounds: np.ndarray, blocks: int) -> np.ndarray:
    """Half-widths of the shares' 95 % intervals, (P), by a jackknife over blocks of neighbouring windows."""
    parts = np.array_split(np.arange(len(missing)), blocks)
    left_out = np.array(
        [
            ForceRegression.fit(np.delete(missing, part, 0), np.delete(changes, part, 0), bounds).shares
            for part in parts
            if len(part)
        ]
    )
    return student_t.ppf(0.975, len(left_out) - 1) * np.sqrt((len(left_out) - 1) * left_out.var(0))


def _acts_on_one(effect: Effect, simulation: Simulation) -> bool:
    """Whether an effect acts on a single joint or body."""
    if (bodies := getattr(effect, "bodies", None)) is not None:
        return len(selection.bodies(simulation.spec(), bodies)) == 1
    return len(elements(effect, simulation)) == 1


def _change(simulation: Simulation, motion: Motion, missing: np.ndarray, entry: CatalogueEntry) -> np.ndarray | None:
    """Change of the missing force, (W, nv), by an entry's first trial, NaN as the force; None if there is none.

    The solver softens dry friction by the joint's mobility: a light link without its rotor meets viscous friction
    instead, so that a trial of friction alone would say nothing of friction and rotor together. The change by friction
    is therefore that beside a heavy rotor.
    """
    try:
        if isinstance(entry.effect, JointFrictionLoss):
            simulation = simulation.with_effects(_heavy_rotor(simulation.model, entry.effect.joints))
            missing = missing_force(simulation, motion)
        change = _missing_force_with(simulation, [entry.starts[0]], motion) - missing
    except ValueError:  # a value that the model rejects
        return None
    known = change[motion.moving]
    return change if np.isfinite(known).all() and np.abs(known).max() > 0.0 else None


def _missing_force_with(simulation: Simulation, effects: Iterable[Effect], motion: Motion) -> np.ndarray:
    """The missing force with effects, (W, nv), where no actuator acts in units of the inertia that they leave there.

    Where no actuator acts, as at the pole of a cart-pole, all forces are in proportion to the masses beyond the joint.
    Without masses none would be missing, so that noise alone would make them as small as allowed.
    """
    changed = simulation.with_effects(*effects)
    before, after = (which.dof_M0 - which.dof_armature for which in (simulation.model, changed.model))
    driven = np.isin(np.arange(simulation.model.nv), list(selection.driven_dofs(simulation.model)))
    known = ~driven & (before > 0.0) & (after > 0.0)
    return missing_force(changed, motion) * np.where(known, before / np.where(known, after, 1.0), 1.0)


def _heavy_rotor(model: mujoco.MjModel, joints: selection.Names) -> Armature:
    """A rotor with which the joints have a thousand times their inertia."""
    inertia = 1.0 / max(model.dof_invweight0[selection.joint_dofs(model, joints)].min(), 1e-9)
    return Armature(_HEAVY * inertia, joints)


def _needed(missing: np.ndarray, changes: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Share of each trial, (P), in the smallest set that explains the force nearly as well as all of them; else 0.

    The force at each coordinate counts for itself as well, so that one joint among many keeps its friction. In the
    mean, all coordinates count alike, however many of their forces are known.

    Args:
        missing: (W, nv), NaN where unknown.
        changes: (W, nv, P), of the trials.
        bounds: (2, P), smallest and largest share of each trial.
    """
    kept = np.arange(changes.shape[-1])
    whole = found = ForceRegression.fit(missing, changes, bounds)
    least = whole.losses(whole.scale)
    while len(kept):
        fewer = np.delete(kept, found.least_needed)
        smaller = ForceRegression.fit(missing, changes[..., fewer], bounds[:, fewer])
        losses = smaller.losses(whole.scale)
        one_is_worse = (losses > MORE_LEFT_OF_ONE * least).any()
        if one_is_worse or np.nanmean(losses) > MORE_LEFT * np.nanmean(least):
            break
        kept, found = fewer, smaller
    shares = np.zeros(changes.shape[-1])
    shares[kept] = found.shares
    return shares


def _simplest(
    shares: np.ndarray, changes: np.ndarray, bounds: np.ndarray, entries: Sequence[CatalogueEntry]
) -> np.ndarray:
    """The shares, (P), with effects that change the force alike replaced by the first of them in ``PROPOSED``.

    On a rail, a rotor, the mass of the cart and a payload are the same; then rounding would choose one of them.
    """
    shares, columns = shares.copy(), np.nan_to_num(changes.reshape(-1, changes.shape[-1]))
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    order = sorted(range(len(entries)), key=lambda index: PROPOSED.index(type(entries[index].effect)))
    for index in np.flatnonzero(shares).tolist():
        for simpler in order[: order.index(index)]:
            along = columns[:, index] @ columns[:, simpler]
            instead = shares[index] * along / size[simpler] ** 2
            alike = abs(along) > _ALIKE * size[index] * size[simpler]
            if alike and shares[simpler] == 0.0 and bounds[0, simpler] <= instead <= bounds[1, simpler]:
                shares[index], shares[simpler] = 0.0, instead
                break
    return shares


def _scaled(entry: CatalogueEntry) -> tuple[str, ...]:
    """The parameters by which an entry's trial is scaled; the place of a payload stays that of the trial."""
    moved = (name for name, value in entry.trials[0].items() if value != entry.effect.parameters[name].neutral)
    return ("mass",) if isinstance(entry.effect, Payload) else tuple(moved)


def _bounds(entry: CatalogueEntry, model: mujoco.MjModel) -> tuple[float, float]:
    """Smallest and largest share of an entry's first trial that its bounds and the model allow."""
    lowest, highest, least = -np.inf, np.inf, lowest_value(entry.effect, model)
    for name in _scaled(entry):
        parameter, trial = entry.effect.parameters[name], entry.trials[0][name]
        allowed = (max(parameter.bounds[0], least), parameter.bounds[1])
        ends = sorted((bound - parameter.neutral) / (trial - parameter.neutral) for bound in allowed)
        lowest, highest = max(lowest, ends[0]), min(highest, ends[1])
    return lowest, highest


def _step(entry: CatalogueEntry, name: str) -> float:
    """Distance of a parameter's first trial from the value without effect."""
    return entry.trials[0][name] - entry.effect.parameters[name].neutral


def _at(entry: CatalogueEntry, share: float, model: mujoco.MjModel) -> Effect:
    """An entry's effect at a share of its first trial, within what its bounds and the model allow."""
    values, least = dict(entry.trials[0]), lowest_value(entry.effect, model)
    for name in _scaled(entry):
        parameter = entry.effect.parameters[name]
        low, high = parameter.bounds
        values[name] = float(np.clip(parameter.neutral + share * _step(entry, name), max(low, least), high))
    return entry.effect.with_parameters(values)
