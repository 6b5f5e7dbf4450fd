"""The force that a simulator lacks along the measured motion, by inverse dynamics.

A simulation over several steps says little where a torque moves a light link: noise of the torque, or a small error of
the friction, is enough to make it run away. The force that the motion needs shows the same error in N or N·m, whatever
the inertia is.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_h2o.residuals.measured.residual import executed_actions, start_states
from torchrl_h2o.residuals.measured.sensor_noise import sensor_noise
from torchrl_h2o.residuals.measured.transitions import Measured, Split, thinned
from torchrl_h2o.residuals.settings import DEFAULTS, InverseDynamicsSettings
from torchrl_h2o.residuals.simulation.simulation import Simulation

LOWER = 0.95  # factor on a missing force below which it falls; chance alone changes it less
_MEDIAN_OF_NORMAL = 0.6745  # median size of a normal number, in its standard deviation
_WITHOUT_CONTACTS = (mujoco.mjtConstraint.mjCNSTR_EQUALITY, mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF)


@dataclass(frozen=True, eq=False)
class Motion:
    """Measured motion over short windows.

    Args:
        position: (W, K, nq), at K rows of each window.
        velocity: (W, K, nv), at these rows.
        acceleration: (W, nv), mean over the window.
        control: (W, nu), executed actions, mean over the window.
        time: (W, K), in s.
        moving: (W, nv), whether a degree of freedom moves in one direction throughout the window, and faster than a
            share of its usual speed; all windows of one that hardly ever does.
    """

    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    control: np.ndarray
    time: np.ndarray
    moving: np.ndarray


def measured_motion(
    simulation: Simulation,
    measured: Measured,
    split: Split,
    settings: InverseDynamicsSettings = DEFAULTS.inverse_dynamics,
) -> Motion | None:
    """The motion in windows that reach ``half_width`` to both sides of a row, long enough to average out noise.

    Windows with unknown states, as those at the ends of a run with late sensors, are left out. So are windows with
    contacts or joints at their stops, whose forces depend on the acceleration within the physics step.

    Args:
        simulation: the simulator, whose effects on sensors and actions are applied.
        measured: the data.
        split: part of the data.
        settings: rows and smoothing.

    Returns:
        The motion in evenly spread windows; None if coordinates are unobserved, if actuators have a state of their own,
        which is not measured, or if the windows are too few.
    """
    if simulation.model.na or not simulation.state_map.observe.any(0).all():
        return None
    half = max(1, round(settings.half_width / simulation.control_step))
    starts = thinned(measured.windows(2 * half + 1, split=split), settings.rows)
    states, model = start_states(simulation, measured), simulation.model
    rows = starts[:, None] + np.linspace(0, 2 * half, min(2 * half + 1, settings.rows_in_window)).round().astype(int)
    rows = rows[np.isfinite(states[rows]).all((1, 2))]
    rows = rows[_free_of_contacts(simulation, states[rows, : model.nq])]
    if len(rows) < settings.least_rows:
        return None
    actions, velocity = executed_actions(simulation, measured), states[rows, model.nq :]
    slowest = settings.resting * velocity.std((0, 1))
    moving = (velocity > slowest).all(1) | (velocity < -slowest).all(1)
    return Motion(
        states[rows, : model.nq],
        velocity,
        (states[rows[:, -1]] - states[rows[:, 0]])[:, model.nq :] / (2.0 * half * simulation.control_step),
        actions[rows[:, :1] + np.arange(2 * half)].mean(1),
        measured.time[rows],
        moving | (moving.sum(0) < settings.least_moving),
    )


def _free_of_contacts(simulation: Simulation, position: np.ndarray) -> np.ndarray:
    """Mask (W) of windows in which nothing touches and no joint is at its stops, from positions (W, K, nq)."""
    model = simulation.model
    data, free = mujoco.MjData(model), []
    for qpos in position.reshape(-1, model.nq):
        data.qpos[:] = qpos
        mujoco.mj_fwdPosition(model, data)
        free.append(bool(np.isin(data.efc_type, _WITHOUT_CONTACTS).all()))
    return np.all(np.reshape(free, position.shape[:2]), axis=1)


def missing_force(simulation: Simulation, motion: Motion) -> np.ndarray:
    """Generalised force that the measured motion needs beyond what the simulator has, mean over each window.

    Returns:
        (W, nv) in N or N·m; NaN for joints that rest or turn around in the window, where dry friction may have any size
        up to its largest one.
    """
    model = simulation.model
    data, (windows, rows) = mujoco.MjData(model), motion.time.shape
    needed = np.empty((windows, rows, model.nv))
    for window in range(windows):
        data.qacc[:], data.ctrl[:] = motion.acceleration[window], motion.control[window]
        for row in range(rows):
            data.qpos[:], data.qvel[:] = motion.position[window, row], motion.velocity[window, row]
            mujoco.mj_inverse(model, data)
            mujoco.mj_fwdActuation(model, data)
            needed[window, row] = data.qfrc_inverse - data.qfrc_actuator
    position, velocity = (each.reshape(windows * rows, -1) for each in (motion.position, motion.velocity))
    control = np.repeat(motion.control, rows, axis=0)
    for force in simulation.pipeline.batched_forces(model):
        needed -= force(position, velocity, control, motion.time.ravel()).reshape(needed.shape)
    weights = np.ones(rows)
    weights[[0, -1]] = 0.5  # trapezoidal rule
    return np.where(motion.moving, np.average(needed, axis=1, weights=weights), np.nan)


@dataclass(frozen=True, eq=False)
class MissingForces:
    """Usual sizes of the forces that the measured motion needs, in N or N·m.

    Args:
        before: (nv), beyond those of a simulator.
        after: (nv), beyond those of the simulator with effects.
        by_noise: (nv), what the sensors' noise alone makes missing with the effects.
    """

    before: np.ndarray
    after: np.ndarray
    by_noise: np.ndarray | float = 0.0

    @property
    def factors(self) -> np.ndarray:
        """(nv), by which the effects multiply what is missing.

        Forces far below the largest one do not count, nor a rise up to twice what noise explains.
        """
        floor = 1e-3 * max(self.before.max(), self.after.max(), 1e-12)
        before = np.maximum(self.before, np.minimum(2.0 * self.by_noise, self.after))
        return (self.after + floor) / (before + floor)

    def rise_by(self, factor: float) -> bool:
        """Whether the effects raise one force by more than a factor, and do not lower the others as much.

        A rise by more than twice the factor counts whatever becomes of the others; one by more than its root counts if
        no other force falls, because a right effect lowers one.
        """
        factors = self.factors
        highest, falls = factors.max(), factors.min() < LOWER
        together = float(np.log(factors).sum())
        return bool(
            highest > 2.0 * factor or (highest > factor and together > 0.0) or (highest > factor**0.5 and not falls)
        )

    def fall_by(self, factor: float) -> bool:
        """Whether the effects multiply the product of all forces by less than a factor below one."""
        return bool(np.log(self.factors).sum() < np.log(factor))


def missing_forces(
    simulation: Simulation,
    mended: Simulation,
    measured: Measured,
    split: Split,
    settings: InverseDynamicsSettings = DEFAULTS.inverse_dynamics,
) -> MissingForces | None:
    """The forces that a simulator lacks without and with effects; None if :func:`measured_motion` gives no motion."""
    motion, same = (measured_motion(which, measured, split, settings) for which in (simulation, mended))
    if motion is None or same is None:
        return None
    before, after = _usual_size(simulation, motion), _usual_size(mended, same)
    return MissingForces(before, after, _by_noise(mended, measured, same, settings))


def _usual_size(simulation: Simulation, motion: Motion) -> np.ndarray:
    """Median sizes of the missing forces, (nv)."""
    return np.nanmedian(np.abs(missing_force(simulation, motion)), axis=0)


def _by_noise(
    simulation: Simulation, measured: Measured, motion: Motion, settings: InverseDynamicsSettings
) -> np.ndarray | float:
    """Usual size of the force, (nv), that noise of the measured velocities makes missing."""
    if (std := sensor_noise(simulation, measured)) is None:
        return 0.0
    model, observe = simulation.model, simulation.state_map.observe
    of_velocity = np.abs(observe[:, model.nq :].T) @ std  # each velocity has one sensor
    half = max(1, round(settings.half_width / simulation.control_step))
    acceleration = np.sqrt(2.0) * of_velocity / (2.0 * half * simulation.control_step)
    data, inertia = mujoco.MjData(model), np.empty((model.nv, model.nv))
    sizes = []
    for position in motion.position[:: max(1, len(motion.position) // 20), 0]:
        data.qpos[:] = position
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fullM(model, data, inertia)
        sizes.append(np.sqrt(inertia**2 @ acceleration**2))
    return _MEDIAN_OF_NORMAL * np.median(sizes, axis=0)
