"""Whether the measured motion needs larger forces with the effects found than the simulator lacks without them."""

from __future__ import annotations

from torchrl_h2o.residuals.measured.missing_force import MORE_FORCE, MissingForces
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
