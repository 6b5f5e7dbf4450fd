"""Families: the same effect on each of several joints or motors, such as the friction of every joint of an arm."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco

from torchrl_h2o.effects import CatalogueEntry, Effect, selection
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.trace.state import SearchState


def entries_of_elements(
    entry: CatalogueEntry, catalogue: Sequence[CatalogueEntry], simulation: Simulation
) -> tuple[CatalogueEntry, ...]:
    """The entries with the same effect on each of the joints or motors of an entry; empty if it acts on fewer than two.

    Args:
        entry: an entry of the catalogue.
        catalogue: all entries.
        simulation: simulator, for its joints and motors.
    """
    own = elements(entry.effect, simulation)
    if len(own) < 2:
        return ()
    alike = [other for other in catalogue if type(other.effect) is type(entry.effect)]
    alone = {acted_on[0]: other for other in alike if len(acted_on := elements(other.effect, simulation)) == 1}
    return tuple(alone[one] for one in own) if alone.keys() >= set(own) else ()


def elements(effect: Effect, simulation: Simulation) -> tuple[int, ...]:
    """Indices in the model of the joints, or of the motors, that an effect acts on; empty for other effects."""
    if (joints := getattr(effect, "joints", None)) is not None:
        of_dof = simulation.model.dof_jntid
        return tuple(dict.fromkeys(int(of_dof[dof]) for dof in selection.joint_dofs(simulation.model, joints)))
    if hasattr(effect, "actuators"):
        chosen = getattr(effect, "actuators", None)
        return tuple(range(simulation.model.nu)) if chosen is None else chosen
    return ()


def acted_on(effect: Effect, simulation: Simulation) -> tuple[int, ...]:
    """Indices of the joints that an effect acts on, by itself or through its motors; empty for other effects."""
    if getattr(effect, "joints", None) is not None:
        return elements(effect, simulation)
    of_joints = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    model = simulation.model
    motors = [motor for motor in elements(effect, simulation) if model.actuator_trntype[motor] in of_joints]
    return tuple(int(model.actuator_trnid[motor, 0]) for motor in motors)


def number_of_effects(state: SearchState) -> int:
    """Number of effects found; the same effect on several single joints or motors counts as one."""
    acting = [(type(entry.effect), elements(entry.effect, state.problem.simulation)) for entry in state.entries]
    alone = [kind for kind, acted_on in acting if len(acted_on) == 1]
    return len(acting) - len(alone) + len(set(alone))
