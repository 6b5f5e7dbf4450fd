"""Terms of a force that explain the residual of a set of effects, as candidates like those of the catalogue."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np

from torchrl_h2o.effects import (
    ActionBacklash,
    ActionDeadBand,
    ActionSaturation,
    CatalogueEntry,
    Effect,
    JointDamping,
    JointForce,
    JointFrictionLoss,
    JointSpring,
    Pipeline,
    ResidualForce,
)
from torchrl_h2o.effects.catalogue.entry import entry_of
from torchrl_h2o.effects.force.residual_force import degrees_of_freedom
from torchrl_h2o.effects.force.term import ForceTerm
from torchrl_h2o.residuals.forces.inverse_force import force_response, residual_forces, step_path
from torchrl_h2o.residuals.forces.sparse_force import sparse_force
from torchrl_h2o.residuals.forces.terms import TermLibrary
from torchrl_h2o.residuals.measured.residual import residuals
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.simulation.simulation import Simulation

ROWS = 4000  # transitions of the regression


def force_candidates(
    simulation: Simulation,
    measured: Measured,
    states: np.ndarray,
    rows: np.ndarray,
    catalogue: Sequence[CatalogueEntry] = (),
) -> list[tuple[tuple[CatalogueEntry, Effect], ...]]:
    """Regresses the forces that the simulator lacks on a library of terms, for each degree of freedom alone.

    Args:
        simulation: the simulator with the effects found so far.
        measured: the data.
        states: start states, (T, nq + nv).
        rows: (W), the transitions.
        catalogue: effects that are tried anyway; a term that is one of them is no candidate by itself.

    Returns:
        Candidates, each one or several entries with their effects: each term, and all terms on a degree of freedom.
    """
    rows = rows[:: 1 + len(rows) // ROWS]
    residual = residuals(simulation, measured, rows, states=states)[:, 0]
    response = force_response(simulation, measured, rows, states=states)
    forces = residual_forces(simulation, measured, rows, residual=residual, response=response)
    path = step_path(simulation, measured, rows, states=states)
    observed = cast("np.ndarray", simulation.state_map.restore.any(1))
    bent = bent_controls(simulation, measured.action[rows])
    candidates = []
    for freedom in degrees_of_freedom(simulation.model):
        library = TermLibrary(freedom, path, observed, bent)
        terms = sparse_force(library, forces.force[:, freedom.velocity], forces.weight[:, freedom.velocity]).terms
        together = tuple(_entry_of_term(term, catalogue) for term in terms)
        candidates += [(one,) for one in together if isinstance(one[1], ResidualForce)]
        candidates += [together] if len(together) > 1 else []
    return candidates


def _entry_of_term(term: ForceTerm, catalogue: Sequence[CatalogueEntry]) -> tuple[CatalogueEntry, Effect]:
    """The entry and the effect of the catalogue that a term is, or those of a force."""
    effect = effect_of_term(term)
    entry = None if effect is None else entry_of(effect, catalogue)
    return force_entry(ResidualForce((str(term),))) if effect is None or entry is None else (entry, effect)


def force_entry(force: ResidualForce) -> tuple[CatalogueEntry, ResidualForce]:
    """An entry for a force, whose numbers are fitted except the start times of steps; and the force."""
    values = {name: one.value for name, one in force.parameters.items() if not name.startswith("start")}
    zeros = {name: 0.0 for name in values if name.startswith("coefficient")}
    return CatalogueEntry(force.with_parameters(zeros), (values,)), force


def bent_controls(simulation: Simulation, actions: np.ndarray) -> list[int]:
    """The controls that a saturation, dead band or backlash of the simulator changes for some of the actions (W, nu).

    Powers of such a control imitate the effect; a fit of both would leave the values of both open.
    """
    bending = ActionSaturation | ActionDeadBand | ActionBacklash
    changed = np.zeros(simulation.model.nu, bool)
    for effect in simulation.effects:
        if isinstance(effect, bending):
            executed = Pipeline((effect,)).executed_run(actions, simulation.control_step)
            changed |= (executed != actions).any(0)
    return np.flatnonzero(changed).tolist()


def effect_of_term(term: ForceTerm) -> Effect | None:
    """Returns the effect on a joint that a term of a force describes; None if there is none.

    A positive coefficient of ``v``, ``q`` or ``sign(v)`` has none, although a model may have too much friction.

    Examples:
        >>> effect_of_term(ForceTerm.parse("torque on elbow: -0.06 · sign(v)")).describe()
        'dry friction of joints elbow + 0.06 N·m'
        >>> effect_of_term(ForceTerm.parse("torque on elbow: 0.06 · sign(v)")) is None  # a force along the motion
        True
    """
    factors = " · ".join(map(str, term.factors))
    if factors == "":
        return JointForce(term.coefficient, joints=term.joint)
    resistance = {"sign(v)": JointFrictionLoss, "v": JointDamping, "q": JointSpring}
    if factors not in resistance or term.coefficient >= 0.0:
        return None
    return resistance[factors](-term.coefficient, joints=term.joint)
