"""The parts of a machine that an effect acts on."""

from __future__ import annotations

from torchrl_h2o.effects import Effect, selection
from torchrl_h2o.residuals.simulation.simulation import Simulation


def elements(effect: Effect, simulation: Simulation) -> tuple[int, ...]:
    """Indices in the model of the joints, or of the motors, that an effect acts on; empty for other effects."""
    if (joints := getattr(effect, "joints", None)) is not None:
        of_dof = simulation.model.dof_jntid
        return tuple(dict.fromkeys(int(of_dof[dof]) for dof in selection.joint_dofs(simulation.model, joints)))
    if hasattr(effect, "actuators"):
        chosen = getattr(effect, "actuators", None)
        return tuple(range(simulation.model.nu)) if chosen is None else chosen
    return ()


def all_elements(effect: Effect, simulation: Simulation) -> tuple[int, ...]:
    """As :func:`elements`, and the bodies or the geoms that an effect acts on."""
    if (bodies := getattr(effect, "bodies", None)) is not None:
        return tuple(selection.body_ids(simulation.model, bodies))
    if (geoms := getattr(effect, "geoms", None)) is not None:
        return tuple(selection.geom_ids(simulation.model, geoms))
    return elements(effect, simulation)
