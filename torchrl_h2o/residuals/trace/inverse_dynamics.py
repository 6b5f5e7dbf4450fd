"""Proposes effects from a regression of the forces that the simulator lacks along the measured motion.

Where friction takes most of a motor's torque, a simulator without friction runs away within a few control steps. Its
error is then far from linear in the effects, and a rotor so heavy that nothing moves lowers it more than any single
right effect does. The force that is missing at the measured positions, velocities and accelerations is nearly linear
in the effects, so a regression finds all of them together, as in the identification of robot arms: Atkeson, An and
Hollerbach (1986), Estimation of Inertial Parameters of Manipulator Loads and Links, International Journal of Robotics
Research 5(3), 101-119.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import mujoco
import numpy as np
from scipy.optimize import lsq_linear

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
from torchrl_h2o.residuals.measured.residual import executed_actions, start_states
from torchrl_h2o.residuals.measured.transitions import Measured, Split, thinned
from torchrl_h2o.residuals.settings import DEFAULTS, InverseDynamicsSettings
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.trace.families import elements

#: the properties of links and joints that are identified; the gain of a motor is not among them, because with a gain of
#: zero and masses of zero no force would be missing
PROPOSED = (JointFrictionLoss, JointDamping, JointSpring, JointForce, Armature, BodyMass, Payload)
#: where the model holds a joint's own value, below which an effect cannot reduce it
OWN_VALUES: Mapping[type[Effect], str] = MappingProxyType(
    {
        JointFrictionLoss: "dof_frictionloss",
        JointDamping: "dof_damping",
        Armature: "dof_armature",
        JointSpring: "jnt_stiffness",
    }
)


@dataclass(frozen=True, eq=False)
class _Motion:
    """Measured motion and executed actions about some rows: qpos (W, nq), qvel and qacc (W, nv), ctrl (W, nu)."""

    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    control: np.ndarray
    time: np.ndarray


def propose_effects(
    simulation: Simulation,
    measured: Measured,
    catalogue: Sequence[CatalogueEntry],
    advance: Callable[[], object] = lambda: None,
    settings: InverseDynamicsSettings = DEFAULTS.inverse_dynamics,
) -> tuple[tuple[CatalogueEntry, Effect], ...]:
    """The properties of single links and joints that together explain the missing force.

    All are fitted together, and then left out one by one, the one that is needed least first. Velocities and
    accelerations come from differences over ``half_width``, so the motion must be slow, as it is where a joint that
    keeps its velocity is a good guess.

    Args:
        simulation: the simulator.
        measured: the data, of which the part for fits is used.
        catalogue: effects that the simulator may lack.
        advance: called after each entry.
        settings: rows, smoothing and the size of the set.

    Returns:
        The entries, each with its effect at the value of the regression; empty if coordinates are unobserved, if
        actuators have a state of their own, which is not measured, or if the rows are too few.
    """
    if simulation.model.na or not simulation.state_map.observe.any(0).all():
        return ()
    half = max(1, round(settings.half_width / simulation.control_step))
    motion = _motion(simulation, measured, _rows(measured, half, settings), half)
    if len(motion.time) < settings.least_rows:
        return ()
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
        return ()
    bounds = np.array([_bounds(entry, simulation.model) for entry in entries]).T
    shares = _needed(missing, np.stack(columns, axis=-1), bounds, settings)
    return tuple((entry, _at(entry, share)) for entry, share in zip(entries, shares, strict=True) if share != 0.0)


def missing_force(simulation: Simulation, motion: _Motion) -> np.ndarray:
    """Generalised force, (W, nv) in N or N·m, that the measured motion needs beyond what the simulator has."""
    model = simulation.model
    data, needed = mujoco.MjData(model), np.empty_like(motion.acceleration)
    for row in range(len(needed)):
        data.qpos[:], data.qvel[:] = motion.position[row], motion.velocity[row]
        data.qacc[:], data.ctrl[:] = motion.acceleration[row], motion.control[row]
        mujoco.mj_inverse(model, data)
        mujoco.mj_fwdActuation(model, data)
        needed[row] = data.qfrc_inverse - data.qfrc_actuator
    for force in simulation.pipeline.batched_forces(model):
        needed -= force(motion.position, motion.velocity, motion.control, motion.time)
    return needed


def _rows(measured: Measured, half: int, settings: InverseDynamicsSettings) -> np.ndarray:
    """Rows for fits, evenly spread, with ``half`` rows of their run on both sides."""
    return thinned(measured.windows(2 * half + 1, split=Split.FIT), settings.rows) + half


def _motion(simulation: Simulation, measured: Measured, rows: np.ndarray, half: int) -> _Motion:
    """The motion from differences over ``half`` rows on both sides, which average the sensors' noise.

    Rows next to unknown states, as those at the ends of a run with late sensors, are left out.
    """
    states, model = start_states(simulation, measured), simulation.model
    known = np.flatnonzero(np.isfinite(states).all(1))
    rows = rows[np.all([np.isin(rows + offset, known) for offset in (-half, 0, half)], axis=0)]
    seconds, before, after = 2.0 * half * simulation.control_step, states[rows - half], states[rows + half]
    velocity = np.empty((len(rows), model.nv))
    for found, one, other in zip(velocity, before, after, strict=True):
        mujoco.mj_differentiatePos(model, found, seconds, one[: model.nq], other[: model.nq])
    actions = executed_actions(simulation, measured)
    return _Motion(
        states[rows, : model.nq],
        velocity,
        (after - before)[:, model.nq :] / seconds,
        actions[rows[:, None] + np.arange(-half, half)].mean(1),
        measured.time[rows],
    )


def _acts_on_one(effect: Effect, simulation: Simulation) -> bool:
    """Whether an effect acts on a single joint or body."""
    if (bodies := getattr(effect, "bodies", None)) is not None:
        return len(selection.bodies(simulation.spec(), bodies)) == 1
    return len(elements(effect, simulation)) == 1


def _change(simulation: Simulation, motion: _Motion, missing: np.ndarray, entry: CatalogueEntry) -> np.ndarray | None:
    """Change of the missing force, (W, nv), by an entry's first trial; None if there is none."""
    try:
        change = missing_force(simulation.with_effects(entry.starts[0]), motion) - missing
    except ValueError:  # a value that the model rejects
        return None
    return change if np.isfinite(change).all() and np.abs(change).max() > 0.0 else None


def _needed(
    missing: np.ndarray, changes: np.ndarray, bounds: np.ndarray, settings: InverseDynamicsSettings
) -> np.ndarray:
    """Share of each trial, (P), in the smallest set that explains the force nearly as well as all of them; else 0.

    Args:
        missing: (W, nv).
        changes: (W, nv, P), of the trials.
        bounds: (2, P), smallest and largest share of each trial.
        settings: how much more than the whole set a smaller one may leave.
    """
    kept = np.arange(changes.shape[-1])
    whole = found = _Regression.fit(missing, changes, bounds)
    while len(kept):
        fewer = np.delete(kept, found.least_needed)
        smaller = _Regression.fit(missing, changes[..., fewer], bounds[:, fewer])
        if smaller.loss(whole.scale) > settings.more_left * whole.loss(whole.scale):
            break
        kept, found = fewer, smaller
    shares = np.zeros(changes.shape[-1])
    shares[kept] = found.shares
    return shares


@dataclass(frozen=True, eq=False)
class _Regression:
    """A robust regression of forces.

    Args:
        shares: coefficients, (P).
        left: (W, nv), forces that are left.
        scale: (nv), usual size of what is left.
        least_needed: index of the coefficient without which the weighted square of what is left rises least; 0 if there
            is no coefficient.
    """

    shares: np.ndarray
    left: np.ndarray
    scale: np.ndarray
    least_needed: int

    @classmethod
    def fit(cls, missing: np.ndarray, changes: np.ndarray, bounds: np.ndarray, rounds: int = 6) -> _Regression:
        """Least squares with weights for the usual size of each force, and less weight for unusually large ones."""
        left, shares, cost = missing, np.zeros(0), np.zeros(1)
        for _ in range(rounds if changes.shape[-1] else 0):
            scale = _usual(left)
            root = 1.0 / (scale * np.sqrt(np.maximum(1.0, np.abs(left / scale) / 2.0)))
            shares, cost = _least_squares((missing * root).ravel(), changes * root[..., None], bounds)
            left = missing + changes @ shares
        return cls(shares, left, _usual(left), int(cost.argmin()))

    def loss(self, scale: np.ndarray) -> float:
        """Mean robust loss of what is left, in units of ``scale``."""
        return float(np.log1p((self.left / scale) ** 2).mean())


def _least_squares(y: np.ndarray, changes: np.ndarray, bounds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bounded shares, (P), that minimise the square of ``y`` plus the changes, and its rise without each of them."""
    x = changes.reshape(len(y), -1)
    size = np.maximum(np.linalg.norm(x, axis=0), 1e-300)
    inner = (x / size).T @ (x / size) + 1e-9 * np.eye(len(size))
    factor = np.linalg.cholesky(inner)
    towards = np.linalg.solve(factor, -(x / size).T @ y)
    scaled = lsq_linear(factor.T, towards, bounds * size, method="bvls").x
    return scaled / size, scaled**2 / np.diag(np.linalg.inv(inner))


def _usual(force: np.ndarray) -> np.ndarray:
    return 1.4826 * np.median(np.abs(force), axis=0) + 1e-12


def _scaled(entry: CatalogueEntry) -> tuple[str, ...]:
    """The parameters by which an entry's trial is scaled; the place of a payload stays that of the trial."""
    moved = (name for name, value in entry.trials[0].items() if value != entry.effect.parameters[name].neutral)
    return ("mass",) if isinstance(entry.effect, Payload) else tuple(moved)


def _bounds(entry: CatalogueEntry, model: mujoco.MjModel) -> tuple[float, float]:
    """Smallest and largest share of an entry's first trial that its bounds and the model allow."""
    lowest, highest, least = -np.inf, np.inf, -_own_value(entry.effect, model)
    for name in _scaled(entry):
        parameter, trial = entry.effect.parameters[name], entry.trials[0][name]
        allowed = (max(parameter.bounds[0], least), parameter.bounds[1])
        ends = sorted((bound - parameter.neutral) / (trial - parameter.neutral) for bound in allowed)
        lowest, highest = max(lowest, ends[0]), min(highest, ends[1])
    return lowest, highest


def _own_value(effect: Effect, model: mujoco.MjModel) -> float:
    """The model's friction, damping, armature or stiffness of an effect's joint; infinite for other effects."""
    if (field := OWN_VALUES.get(type(effect))) is None:
        return np.inf
    dof = selection.joint_dofs(model, getattr(effect, "joints", "*"))[0]
    place = model.dof_jntid[dof] if field.startswith("jnt") else dof
    return float(np.ravel(getattr(model, field)[place])[0])


def _at(entry: CatalogueEntry, share: float) -> Effect:
    """An entry's effect at a share of its first trial."""
    values = dict(entry.trials[0])
    for name in _scaled(entry):
        parameter = entry.effect.parameters[name]
        moved = parameter.neutral + share * (values[name] - parameter.neutral)
        values[name] = float(np.clip(moved, *parameter.bounds))
    return entry.effect.with_parameters(values)
