"""Whether the forces that the measured motion needs contradict the effects found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchrl_h2o.effects import Effect, ResidualForce
from torchrl_h2o.effects.force.residual_force import degrees_of_freedom
from torchrl_h2o.residuals.measured.missing_force import (
    LOWER,
    MORE_FORCE,
    MissingForces,
    measured_motion,
    missing_force,
)
from torchrl_h2o.residuals.measured.transitions import Measured, Split
from torchrl_h2o.residuals.report.words import quantity
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.simulation.state_map import coordinate_names


def needs_more_force(simulation: Simulation, forces: MissingForces) -> tuple[str, ...]:
    """Says so if effects contradict the measured forces: with them, far larger forces are missing than without them.

    A rotor that is too heavy predicts that a joint keeps its velocity, which is a good guess over some steps. But the
    accelerations in the data would then need far larger torques than those that were measured.

    Args:
        simulation: the simulator, for the names of its joints.
        forces: the missing forces without and with the effects, on the part of the data for the report.

    Returns:
        One clause, about the joint whose missing force rises most, or nothing.
    """
    if not forces.rise_by(MORE_FORCE):
        return ()
    dof, model = int(forces.factors.argmax()), simulation.model
    names, units = (each[model.nq + dof] for each in coordinate_names(model))
    unit = "N" if units == "m/s" else "N·m"
    after, before = (quantity(float(which[dof]), unit, 2) for which in (forces.after, forces.before))
    joint = names.removesuffix("_velocity")
    return (f"with the effects found, {after} is missing in the measured motion of {joint}, and {before} without them",)


def force_in_vain(
    simulation: Simulation,
    mended: Simulation,
    measured: Measured,
    effects: Sequence[Effect],
) -> tuple[str, ...]:
    """Says so if a force outside the catalogue is found at a joint, and as much force is missing there as without it.

    Noise of measured torques moves a light link in the simulator, but not in reality. A force against the torque then
    predicts the motion better, although the measured motion does not need it.

    Args:
        simulation: the simulator without the effects.
        mended: the simulator with them.
        measured: the data, of which the part for the report is used.
        effects: the effects found.

    Returns:
        One clause, about the first of these joints, or nothing; nothing if the missing force is not known.
    """
    joints = {term.joint for effect in effects if isinstance(effect, ResidualForce) for term in effect.parsed}
    if not joints:
        return ()
    sizes = []
    for which in (simulation, mended):
        motion = measured_motion(which, measured, Split.REPORT)
        if motion is None:
            return ()
        sizes.append(np.nanmean(np.abs(missing_force(which, motion)), axis=0))  # a mean, as a force may act seldom
    before, after = sizes
    in_vain = [
        freedom.name
        for freedom in degrees_of_freedom(simulation.model)
        if freedom.name in joints and after[freedom.velocity] > LOWER * before[freedom.velocity]
    ]
    where = "as much force is missing in the measured motion of {} with the force found as without it"
    return (where.format(in_vain[0]),) if in_vain else ()
