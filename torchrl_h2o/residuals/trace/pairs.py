"""Predicts pairs from fits of single entries, to find pairs whose first entry alone was not among the best."""

from __future__ import annotations

from collections.abc import Callable, Collection
from itertools import islice
from operator import itemgetter

import numpy as np

from torchrl_h2o.residuals.trace.add import (
    BEAM_LOSS,
    SAME_FIT,
    SET_SIZES,
    Addition,
    Additions,
    distinct,
    sketched_set,
    tested,
)
from torchrl_h2o.residuals.trace.families import number_of_effects
from torchrl_h2o.residuals.trace.problem import losses
from torchrl_h2o.residuals.trace.screening import Lead, along

PAIR = 2


def pairs_by_prediction(
    singles: Additions,
    seen: Collection[frozenset[str]],
    to_beat: float,
    rng: np.random.Generator,
    advance: Callable[[], object] = lambda: None,
) -> Additions:
    """Finds pairs whose first entry passed the tests alone, also if its loss is far above that of the best entry.

    The residual of a pair is predicted without simulation: what the first entry's fit leaves, plus the change by the
    second entry that the screening found. The pairs with the lowest predicted loss get a quick fit, and those that come
    close to the loss to beat get a full one.

    Args:
        singles: single entries that were fitted, and the leads of their screening.
        seen: names of the effects of each list so far; such pairs are left out.
        to_beat: lowest loss of the screened windows that other lists leave.
        rng: generator of synthetic noise.
        advance: called before each full fit.

    Returns:
        The pairs that pass the tests of an addition.
    """
    state = singles.state
    if number_of_effects(state) + PAIR > singles.state.settings.max_effects:
        return Additions(state, singles.leads)
    quick = (
        (leads, sketched_set(state, [*single.fit.effects, leads[-1].effect], leads))
        for single, leads in _predicted(singles, seen)
    )
    possible = ((leads, sketch) for leads, sketch in quick if sketch is not None)
    sketches = islice(possible, dict(SET_SIZES).get(PAIR, 0))
    close = [(leads, sketch) for leads, sketch in sketches if sketch.loss <= BEAM_LOSS * to_beat]
    return tested(state, singles.leads, close, rng, advance)


def _predicted(singles: Additions, seen: Collection[frozenset[str]]) -> list[tuple[Addition, tuple[Lead, Lead]]]:
    """Each new pair once, with the fit of its first entry, in ascending order of the predicted loss."""
    state, screened = singles.state, singles.state.windows.screened
    by_name = {lead.entry.name: lead for lead in singles.leads}
    predicted = []
    for single in (one for one in singles.passed if one.added == 1):
        effects, first = single.fit.effects, by_name[single.entries[-1].name]
        left = state.problem.residual(effects, screened)
        names = {entry.name for entry in single.entries}
        for second in singles.leads:
            new = second.entry.name not in names and frozenset({*names, second.entry.name}) not in seen
            if new and second.promise > 0.0:
                _, explained = along(left, second.change.reshape(left.shape))
                predicted.append(((1.0 - explained) * float(losses(left).mean()), single, (first, second)))
    ranked = distinct(sorted(predicted, key=itemgetter(0)), itemgetter(0), SAME_FIT)
    pairs: dict[frozenset[str], tuple[Addition, tuple[Lead, Lead]]] = {}
    for _, single, leads in ranked:
        pairs.setdefault(frozenset(lead.entry.name for lead in leads), (single, leads))
    return list(pairs.values())
