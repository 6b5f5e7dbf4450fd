"""Replaces a force outside the catalogue by effects of the catalogue if each of its terms is one, such as dry friction.

The search for a force may accept a weak effect that the search over the catalogue rejects, because it tries fewer
alternatives. A force -0.06 · sign(v), for example, is dry friction.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

from torchrl_h2o.effects import (
    CatalogueEntry,
    Effect,
    JointDamping,
    JointForce,
    JointFrictionLoss,
    JointSpring,
    ResidualForce,
)
from torchrl_h2o.effects.catalogue.entry import entry_of
from torchrl_h2o.effects.force.term import ForceTerm
from torchrl_h2o.residuals.explanation import Part
from torchrl_h2o.residuals.settings import DEFAULTS, LoopSettings
from torchrl_h2o.residuals.trace.choose_horizon import fitted_in_longer_windows
from torchrl_h2o.residuals.trace.fit import fit
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.screening import is_possible
from torchrl_h2o.residuals.trace.significance import p_value_of_losses
from torchrl_h2o.residuals.undeclared.needed import MIN_GAIN_OVER_CATALOGUE

Parts = tuple[Part, ...]


def by_catalogue(
    problem: Problem, parts: Parts, catalogue: Sequence[CatalogueEntry], settings: LoopSettings = DEFAULTS
) -> Parts:
    """Replaces the force in an explanation by effects of the catalogue if these explain the held-out data as well.

    Args:
        problem: simulation without the parts, data and scales of the residuals.
        parts: effects of the catalogue, then the force.
        catalogue: effects that the simulator may lack.
        settings: thresholds and budgets.

    Returns:
        The effects, fitted together; the parts as they are if a term of the force is no effect of the catalogue, or if
        the effects explain the data less well.
    """
    known, force = parts[:-1], cast("ResidualForce", parts[-1].effect)
    named = [effect_of_term(term) for term in force.parsed]
    entries = [None if effect is None else entry_of(effect, catalogue) for effect in named]
    if None in entries:
        return parts
    there = [entry_of(part.effect, catalogue) for part in known]  # the fit moves their values
    added = [effect for effect, entry in zip(named, entries, strict=True) if entry not in there]
    effects = [*(part.effect for part in known), *cast("list[Effect]", added)]
    free = [*(tuple(part.ci95) for part in known), *(tuple(effect.parameters) for effect in effects[len(known) :])]
    starts = problem.measured.fitted(problem.horizon)
    if not is_possible(problem, effects):
        return parts
    result = fit(problem, effects, free, starts, max_evaluations=settings.max_evaluations)
    before, after = (problem.selection_losses(some) for some in ([part.effect for part in parts], result.effects))
    worse = after.mean() > before.mean() / (1.0 - MIN_GAIN_OVER_CATALOGUE)
    if worse and p_value_of_losses(after, before, settings) < settings.level:
        return parts
    result = fitted_in_longer_windows(problem, result, settings)
    # alternatives of the effects were found without the force
    return tuple(Part(effect, True, result.ci95(index)) for index, effect in enumerate(result.effects))


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
