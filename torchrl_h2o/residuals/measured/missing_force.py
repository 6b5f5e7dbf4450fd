"""The force that a simulator lacks along the measured motion.

A simulation over several steps says little where a torque moves a light link: noise of the torque, or a small error of
the friction, is enough to make it run away. The force that is missing in the motion shows the same error in N or N·m,
whatever the inertia is.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_h2o.residuals.measured.residual import executed_actions, start_states
from torchrl_h2o.residuals.measured.sensor_noise import sensor_noise
from torchrl_h2o.residuals.measured.transitions import Measured, Split, thinned
from torchrl_h2o.residuals.simulation.simulation import Simulation

# factor by which effects may raise the force that a joint's measured motion needs beyond the simulator's
MORE_FORCE = 1.5
# factor on the product of the missing forces below which effects explain them, whatever the motion shows
LESS_FORCE = 0.5
HALF_WIDTH = 0.025  # half the length, in s, of the windows over which accelerations and forces are averaged
MOST_ROWS = 1500  # largest number of rows in the regression
# parts of a window, in the middle of each of which the simulator's force is computed; their mean counts
PARTS_OF_WINDOW = 10
RESTING_SHARE = 0.1  # share of a joint's usual speed below which it counts as resting
LEAST_MOVING = 50  # smallest number of windows in which a joint moves in one direction for the others to be left out
LEAST_ROWS = 200  # smallest number of rows

LOWER = 0.95  # factor on a missing force below which it falls; chance alone changes it less
_MEDIAN_OF_NORMAL = 0.6745  # median size of a normal number, in its standard deviation
_WITHOUT_CONTACTS = (mujoco.mjtConstraint.mjCNSTR_EQUALITY, mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF)


@dataclass(frozen=True, eq=False)
class Motion:
    """Measured motion over short windows, each of them in K parts.

    Args:
        position: (W, K, nq), in the middle of each part.
        velocity: (W, K, nv), in the middle of each part.
        acceleration: (W, nv), mean over the window.
        control: (W, K, nu), executed actions, mean over each part.
        time: (W, K), in the middle of each part, in s.
        share: (K), of the window, of each part.
        moving: (W, nv), whether a degree of freedom moves in one direction throughout the window, and faster than a
            share of its usual speed; all windows of one that hardly ever does.
    """

    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    control: np.ndarray
    time: np.ndarray
    share: np.ndarray
    moving: np.ndarray


def measured_motion(
    simulation: Simulation,
    measured: Measured,
    split: Split,
) -> Motion | None:
    """The motion in windows that reach ``half_width`` to both sides of a row, long enough to average out noise.

    Windows with unknown states, as those at the ends of a run with late sensors, are left out. So are windows with
    contacts or joints at their stops, whose forces depend on the acceleration within the physics step.

    Args:
        simulation: the simulator, whose effects on sensors and actions are applied.
        measured: the data.
        split: part of the data.

    Returns:
        The motion in evenly spread windows; None if coordinates are unobserved, if actuators have a state of their own,
        which is not measured, or if the windows are too few.
    """
    if simulation.model.na or not simulation.state_map.observe.any(0).all():
        return None
    half = max(1, round(HALF_WIDTH / simulation.control_step))
    starts = thinned(measured.windows(2 * half + 1, split=split), MOST_ROWS)
    states, model = start_states(simulation, measured), simulation.model
    ends = np.linspace(0, 2 * half, min(2 * half, PARTS_OF_WINDOW) + 1).round().astype(int)
    rows = starts[:, None] + ends
    rows = rows[np.isfinite(states[rows]).all((1, 2))]
    rows = rows[_free_of_contacts(simulation, states[rows, : model.nq])]
    if len(rows) < LEAST_ROWS:
        return None
    velocity, steps = states[rows, model.nq :], np.diff(ends)
    slowest = RESTING_SHARE * velocity.std((0, 1))
    moving = (velocity > slowest).all(1) | (velocity < -slowest).all(1)
    middle = (velocity[:, 1:] + velocity[:, :-1]) / 2.0
    later = steps / 2.0 * simulation.control_step
    actions = executed_actions(simulation, measured)[rows[:, :1] + np.arange(2 * half)]
    return Motion(
        _moved(model, states[rows[:, :-1], : model.nq], middle, later),
        middle,
        (velocity[:, -1] - velocity[:, 0]) / (2.0 * half * simulation.control_step),
        np.add.reduceat(actions, ends[:-1], axis=1) / steps[:, None],
        measured.time[rows[:, :-1]] + later,
        steps / steps.sum(),
        moving | (moving.sum(0) < LEAST_MOVING),
    )


def _moved(model: mujoco.MjModel, position: np.ndarray, velocity: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """Positions that are reached from given ones at constant velocity.

    Args:
        model: the model, for the kinds of its joints.
        position: (W, K, nq).
        velocity: (W, K, nv).
        seconds: (K), duration of the motion from each position.

    Returns:
        (W, K, nq).
    """
    moved = position.copy()
    for window in range(len(position)):
        for part, time in enumerate(seconds):
            mujoco.mj_integratePos(model, moved[window, part], velocity[window, part], time)
    return moved


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

    It is the inertia times the difference between the measured and the simulated acceleration. Inverse dynamics with
    the measured acceleration would give another force where friction holds a light link: MuJoCo's dry friction then
    depends on the acceleration within the control step, which the mean over a window is not.

    Returns:
        (W, nv) in N or N·m; NaN for joints that rest or turn around in the window, where dry friction may have any size
        up to its largest one.
    """
    model = simulation.model
    data, (windows, parts) = mujoco.MjData(model), motion.time.shape
    needed, acceleration = np.empty((windows, parts, model.nv)), np.repeat(motion.acceleration, parts, axis=0)
    position, velocity, control = (
        each.reshape(windows * parts, -1) for each in (motion.position, motion.velocity, motion.control)
    )
    applied = np.zeros_like(velocity)
    for force in simulation.pipeline.batched_forces(model):
        applied += force(position, velocity, control, motion.time.ravel())
    for row, force in enumerate(needed.reshape(windows * parts, -1)):
        data.qpos[:], data.qvel[:], data.ctrl[:] = position[row], velocity[row], control[row]
        data.qfrc_applied[:] = applied[row]
        mujoco.mj_forward(model, data)
        mujoco.mj_mulM(model, data, force, acceleration[row] - data.qacc)
    return np.where(motion.moving, np.average(needed, axis=1, weights=motion.share), np.nan)


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
) -> MissingForces | None:
    """The forces that a simulator lacks without and with effects; None if :func:`measured_motion` gives no motion."""
    motion, same = (measured_motion(which, measured, split) for which in (simulation, mended))
    if motion is None or same is None:
        return None
    before, after = _usual_size(simulation, motion), _usual_size(mended, same)
    return MissingForces(before, after, _by_noise(mended, measured, same))


def _usual_size(simulation: Simulation, motion: Motion) -> np.ndarray:
    """Median sizes of the missing forces, (nv)."""
    return np.nanmedian(np.abs(missing_force(simulation, motion)), axis=0)


def _by_noise(simulation: Simulation, measured: Measured, motion: Motion) -> np.ndarray | float:
    """Usual size of the force, (nv), that noise of the measured velocities makes missing."""
    if (std := sensor_noise(simulation, measured)) is None:
        return 0.0
    model, observe = simulation.model, simulation.state_map.observe
    of_velocity = np.abs(observe[:, model.nq :].T) @ std  # each velocity has one sensor
    half = max(1, round(HALF_WIDTH / simulation.control_step))
    acceleration = np.sqrt(2.0) * of_velocity / (2.0 * half * simulation.control_step)
    data, inertia = mujoco.MjData(model), np.empty((model.nv, model.nv))
    sizes = []
    for position in motion.position[:: max(1, len(motion.position) // 20), 0]:
        data.qpos[:] = position
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fullM(model, data, inertia)
        sizes.append(np.sqrt(inertia**2 @ acceleration**2))
    return _MEDIAN_OF_NORMAL * np.median(sizes, axis=0)
