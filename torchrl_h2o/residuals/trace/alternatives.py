"""Finds alternatives: other entries that explain the data equally well in the place of an effect."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from torchrl_h2o.effects import CatalogueEntry, Effect
from torchrl_h2o.effects.catalogue.plausibility import is_outside
from torchrl_h2o.residuals.trace.close_comparison import ALIKE_LOSS, SAME_LOSS
from torchrl_h2o.residuals.trace.families import elements
from torchrl_h2o.residuals.trace.fit import Fit
from torchrl_h2o.residuals.trace.outcome import Attempt
from torchrl_h2o.residuals.trace.problem import Problem, matters
from torchrl_h2o.residuals.trace.screening import SAME_CHANGE, Lead, are_possible_alone, free_parameters, is_possible
from torchrl_h2o.residuals.trace.state import SKETCH_EVALUATIONS, SearchState

# evaluations of the residual in a sketch of an alternative; the other parameters may change much
RIVAL_EVALUATIONS = 20
NEAREST_RIVALS = 12  # number of alternatives tried in an effect's place because their promise was closest to its own
TOP_RIVALS = 6  # number of alternatives tried in an effect's place because their promise was highest
# share of an effect's gain that an alternative must reach in ``sketch_evaluations``; else it is given up
RIVAL_MIN_FIRST = 0.25


def alternatives(
    state: SearchState, index: int, advance: Callable[[], object] = lambda: None
) -> tuple[SearchState, tuple[Attempt, ...]]:
    """Finds entries that explain the held-out data equally well in the place of one of the effects found.

    An alternative with fewer parameters that is significantly worse gets a second test, with residuals scaled by their
    size with the effect instead of without it. It counts as equivalent if this test is not significant and the
    difference is small.

    Args:
        state: effects found.
        index: position of the effect.
        advance: called after each entry that was tried in the effect's place.

    Returns:
        The state with residuals scaled by their size without the effect, and the alternatives, in ascending order of
        their loss.
    """
    kept = [effect for i, effect in enumerate(state.fit.effects) if i != index]
    if not is_possible(state.problem, kept):
        return state, ()
    state = state.rescaled(state.posed_instead(kept))
    with_it = state.selection_losses(state.fit.effects)
    explained = state.selection_losses(kept).mean() - with_it.mean()
    if explained <= 0.0:
        return state, ()  # an effect without a gain has no meaningful alternatives
    attempts = []
    for lead, sketch in _sketched_rivals(state, index):
        if sketch is not None:
            attempts.append(_attempt(state, index, lead, sketch, with_it))
        advance()
    as_good = [attempt for attempt in attempts if _is_equivalent(state, attempt, with_it.mean(), explained)]
    return state, tuple(sorted(as_good, key=lambda attempt: attempt.loss))


def p_value_between(state: SearchState, problem: Problem, worse: Fit, better: Fit) -> float:
    """p-value of the difference between two fits on held-out windows, with residuals scaled as in a problem."""
    before, after = (problem.selection_losses(fitted.effects) for fitted in (worse, better))
    return state.p_value(before, after)


def _rivals(state: SearchState, index: int) -> list[Lead]:
    """Leads whose promise was highest, or closest to the effect's own, or that change the residual as it does.

    All of the screening after which the effect was added. A lead with the same change may have another promise, because
    the promise is limited by the size of the trials.
    """
    own = state.entries[index].name
    leads = state.rivals[own]
    names = {entry.name for entry in state.entries}
    effect = next((lead for lead in leads if lead.entry.name == own), None)
    promise = 0.0 if effect is None else effect.promise
    others = [lead for lead in leads if lead.entry.name not in names and not _repeats(state, index, lead.entry)]
    nearest = sorted(others, key=lambda lead: abs(lead.promise - promise))[:NEAREST_RIVALS]
    same = [] if effect is None else [lead for lead in others if _same_change(lead, effect, SAME_CHANGE)]
    chosen = (*nearest, *others[:TOP_RIVALS], *same[:TOP_RIVALS])
    return list({lead.entry.name: lead for lead in chosen}.values())


def _same_change(one: Lead, other: Lead, same: float) -> bool:
    """Whether two entries change the residual in the same way, up to a factor."""
    sizes = float(np.linalg.norm(one.change)) * float(np.linalg.norm(other.change))
    return sizes > 0.0 and abs(float(one.change @ other.change)) >= same * sizes


def _repeats(state: SearchState, index: int, entry: CatalogueEntry) -> bool:
    """Whether an entry only regroups the effects found.

    Example: with friction of the hip and of the knee found, friction of both in place of the knee's is no alternative.
    """
    simulation, own = state.problem.simulation, state.entries[index]
    others = [other for i, other in enumerate(state.entries) if i != index and type(other.effect) is type(entry.effect)]
    acted_on, wider = set(elements(own.effect, simulation)), set(elements(entry.effect, simulation))
    return type(own.effect) is type(entry.effect) and any(
        wider > acted_on and not wider.isdisjoint(elements(other.effect, simulation)) for other in others
    )


def _sketched_rivals(state: SearchState, index: int) -> Iterator[tuple[Lead, Fit | None]]:
    """Quick fits of all rivals; None for a rival that the model rejects or that misses a share of the effect's gain.

    A rival that is far from the required share after the first evaluations is given up. A rival with the parameters of
    the effect starts from the effect's values if they are better than those of the screening, which knew fewer effects.
    """
    effects = state.fit.effects
    kept = [effect for i, effect in enumerate(effects) if i != index]
    few_with_it, few_without = map(state.screened_loss, (effects, kept))
    gain = few_without - few_with_it
    for lead in _rivals(state, index):
        starts = [
            [*kept[:index], start, *kept[index:]]
            for start in (lead.effect, *_with_values_of(effects[index], lead.effect))
        ]
        starts = [start for start in starts if is_possible(state.problem, start)]
        if not starts:
            yield lead, None
            continue
        instead = min(starts, key=state.screened_loss) if len(starts) > 1 else starts[0]
        free = [free_parameters(entry) for entry in _entries_with(state, index, lead)]
        sketch = state.sketched(instead, free, SKETCH_EVALUATIONS)
        if few_without - sketch.loss >= RIVAL_MIN_FIRST * gain:
            sketch = state.sketched(sketch.effects, free, RIVAL_EVALUATIONS)
        yield lead, sketch if few_without - sketch.loss >= state.rival_min_sketch * gain else None


def _with_values_of(effect: Effect, rival: Effect) -> list[Effect]:
    """The rival with the values of an effect that has the same parameters; empty for other or rejected parameters."""
    values = {name: parameter.value for name, parameter in effect.parameters.items()}
    if values.keys() != rival.parameters.keys():
        return []
    try:
        return [rival.with_parameters(values)]
    except ValueError:  # outside the rival's bounds
        return []


def _entries_with(state: SearchState, index: int, lead: Lead) -> list:
    return [lead.entry if i == index else entry for i, entry in enumerate(state.entries)]


def _attempt(state: SearchState, index: int, lead: Lead, sketch: Fit, with_it: np.ndarray) -> Attempt:
    """A rival fitted in the effect's place, with the p-value of being worse than the effect."""
    candidate = state.refitted(_entries_with(state, index, lead), sketch.effects)
    after = state.selection_losses(candidate.effects)
    p = state.p_value(after, with_it)
    simpler = len(lead.free) < len(free_parameters(state.entries[index]))
    if p <= state.settings.level and simpler:
        p = max(p, _p_value_of_loss_gap(state, candidate, state.fit))
    return Attempt(lead.entry, candidate, index, float(after.mean()), p)


def _is_equivalent(state: SearchState, attempt: Attempt, with_it: float, explained: float) -> bool:
    """Whether an attempt misses a negligible share of the effect's gain, or a small and insignificant one.

    If the effect leaves only rounding, so must the attempt: differences between roundings may be significant.
    """
    problem = state.problem
    if is_outside(attempt.effect, problem.simulation.model) or not are_possible_alone(problem, attempt.fit.effects):
        return False
    worse = (attempt.loss - with_it) / explained
    if worse < SAME_LOSS or worse >= ALIKE_LOSS:
        return bool(worse < SAME_LOSS)
    if state.exact:
        return state.posed_at(attempt.fit.effects).within_rounding
    return attempt.p_value > state.settings.level


def _p_value_of_loss_gap(state: SearchState, worse: Fit, better: Fit) -> float:
    """p-value of the loss gap, rescaled by the better fit; 0 above the reporting threshold."""
    worse_loss, better_loss = (state.first.selection_loss(fitted.effects) for fitted in (worse, better))
    if matters(state.first_loss, worse_loss, better_loss, state.min_share):
        return 0.0
    rescaled = replace(state.posed_at(better.effects), simulation=state.problem.simulation)
    return p_value_between(state, rescaled, worse, better)
