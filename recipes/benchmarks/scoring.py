"""Scores a report against the true effects."""

import dataclasses
import math
from collections.abc import Sequence

from torchrl_h2o.effects import ActionDelay, Effect, ObservationDelay, ResidualForce, selection
from torchrl_h2o.residuals import Report, Simulation
from torchrl_h2o.residuals.report.contents import NOTHING_MISSING

TINY = 1e-9  # values below this are rounded zeros, for which relative errors are undefined


def elements(effect: Effect, simulation: Simulation) -> frozenset:
    """Names or indices of the elements an effect acts on; empty for effects on the whole model.

    Two effects that select the same elements by other patterns are the same.
    """
    effect, spec = _of_motors(effect), simulation.spec()
    by_name = {"bodies": selection.bodies, "joints": selection.joints, "geoms": selection.geoms}
    sizes = {"actuators": simulation.model.nu, "entries": len(simulation.state_map.names)}
    for field in dataclasses.fields(effect):
        chosen = getattr(effect, field.name)
        if field.name in by_name:
            return frozenset(element.name for element in by_name[field.name](spec, chosen))
        if field.name in sizes:
            return frozenset(range(sizes[field.name]) if chosen is None else chosen)
    return frozenset()


def _of_motors(effect: Effect) -> Effect:
    """All sensors late by one time give the same log as all motors late by it."""
    late = isinstance(effect, ObservationDelay) and effect.entries is None
    return ActionDelay(effect.delay) if late else effect


def part_of(effect: Effect, truth: Effect, simulation: Simulation) -> bool:
    """Whether an effect equals a true one on all or some of its elements."""
    same = type(_of_motors(effect)) is type(_of_motors(truth))
    return same and elements(effect, simulation) <= elements(truth, simulation)


def is_named_first(report: Report, truth: Sequence[Effect], simulation: Simulation) -> bool:
    """Whether the first effect found is a true one or in one group with a true one."""
    if not report.found:
        return False
    return any(part_of(e, true, simulation) for e in _alternatives(report, report.effects[0]) for true in truth)


def is_exact_set(report: Report, truth: Sequence[Effect], simulation: Simulation) -> bool:
    """Whether exactly the true effects were found, each directly or through its group."""
    return _is_exactly([_alternatives(report, effect) for effect in report.effects], truth, simulation)


def is_listed_set(report: Report, truth: Sequence[Effect], simulation: Simulation) -> bool:
    """Whether the true effects are one of the other sets that, by the report, explain the data as well."""
    return bool(_listed(report, truth, simulation))


def _listed(report: Report, truth: Sequence[Effect], simulation: Simulation) -> list:
    """The other sets of the report that consist of the true effects."""
    return [other for other in report.others if _is_exactly([[e] for e in other.effects], truth, simulation)]


def _is_exactly(found: Sequence[Sequence[Effect]], truth: Sequence[Effect], simulation: Simulation) -> bool:
    """Whether one effect of each group found is a true one, and each true effect is in a group."""
    no_other = all(any(part_of(e, true, simulation) for e in group for true in truth) for group in found)
    return no_other and all(_is_found(true, found, simulation) for true in truth)


def _is_found(true: Effect, found: Sequence[Sequence[Effect]], simulation: Simulation) -> bool:
    """Whether one or several found effects together cover all elements of a true one."""
    parts = [[elements(e, simulation) for e in group if part_of(e, true, simulation)] for group in found]
    parts = [max(group, key=len) for group in parts if group]
    return bool(parts) and frozenset().union(*parts) == elements(true, simulation)


def _alternatives(report: Report, effect: Effect) -> list[Effect]:
    """An effect found, and those indistinguishable from it."""
    groups = [group.effects for group in report.indistinguishable if effect in group.effects]
    return [effect, *(other for group in groups for other in group if other != effect)]


def parameter_error(report: Report, truth: Sequence[Effect], simulation: Simulation) -> float:
    """Largest relative error of a parameter of the true effects; infinite if an effect was neither found nor listed."""
    # members of a group have values of their own, each fitted in place of the chosen effect
    in_groups = [e for effect in report.effects for e in _alternatives(report, effect)]
    listed = _listed(report, truth, simulation)
    errors = []
    for true in truth:
        found = [e for e in report.effects if part_of(e, true, simulation)]
        found = found or [e for e in in_groups if part_of(e, true, simulation)]
        found = found or [e for other in listed for e in other.effects if part_of(e, true, simulation)]
        errors += [_relative_error(e, true) for e in found] or [math.inf]
    return max(errors, default=0.0)


def _relative_error(effect: Effect, true: Effect) -> float:
    pairs = [(effect.parameters[name].value, p.value) for name, p in true.parameters.items() if p.value != p.neutral]
    return max(abs(found - value) / (abs(value) if abs(value) > TINY else 1.0) for found, value in pairs)


def reduction(report: Report, floor: float = 0.0) -> float:
    """Fraction of the held-out error above the floor that was removed; NaN without a measured error."""
    if report.error is None or not report.error.before > floor:
        return math.nan
    return (report.error.before - report.error.after) / (report.error.before - floor)


def is_marked_undeclared(report: Report) -> bool:
    """Whether the report contains an effect outside the catalogue."""
    return any(not found.declared for found in report.found)


def depends_on_time(effect: Effect) -> bool:
    """Whether an effect is a force with a term in time."""
    terms = effect.parsed if isinstance(effect, ResidualForce) else ()
    return any(factor.coordinate == "t" for term in terms for factor in term.factors)


def says_nothing_is_missing(report: Report) -> bool:
    """Whether the report concludes that nothing is missing; a report without a conclusion does not."""
    said = report.verdict is None or report.verdict.kind == NOTHING_MISSING
    return said and not report.found and report.conclusion is None


def is_reported_as_group(report: Report, alike: Sequence[Effect]) -> bool:
    """Whether effects of all these classes are in one group."""
    classes = {type(effect) for effect in alike}
    return any(classes <= {type(effect) for effect in group.effects} for group in report.indistinguishable)
