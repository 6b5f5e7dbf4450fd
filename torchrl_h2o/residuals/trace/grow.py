"""Grows lists of effects side by side (a beam search): adds sets, drops what they make redundant, and rescales.

A search that keeps only one list fails if a wrong effect imitates two right ones. For example, a heavier torso and
friction of the axles together look like heavier wheels until one of the two has been added.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from operator import itemgetter

import numpy as np

from torchrl_h2o.effects.catalogue.plausibility import surprise
from torchrl_h2o.residuals.progress import LoopBar
from torchrl_h2o.residuals.trace.add import BEAM_LOSS, BEAM_WIDTH, SAME_FIT, Additions, additions, distinct
from torchrl_h2o.residuals.trace.eliminate import eliminate, reorder
from torchrl_h2o.residuals.trace.families import number_of_effects
from torchrl_h2o.residuals.trace.pairs import pairs_by_prediction
from torchrl_h2o.residuals.trace.per_joint import divided_where_shared_harms
from torchrl_h2o.residuals.trace.problem import matters
from torchrl_h2o.residuals.trace.rescale import rescale
from torchrl_h2o.residuals.trace.screening import Lead, free_parameters, screen
from torchrl_h2o.residuals.trace.state import SearchState

SCREENING, ADDITION = 0.07, 0.1  # shares by which a screening and an addition bring the bar closer to the stage's end


def grow(
    state: SearchState,
    rng: np.random.Generator,
    progress: LoopBar,
    found: Callable[[SearchState], object] = lambda state: None,
) -> SearchState:
    """Adds effects until no addition passes the tests, the limit is reached, or the residual is within rounding.

    The first effect is chosen while all others are missing, so a wrong one may look far better than a right one. After
    the second round, the lists therefore also include pairs whose first effect was not among the best single ones.

    Args:
        state: effects found so far.
        rng: generator of synthetic noise.
        progress: bar that moves with every screened entry and names the effects found.
        found: called with the best list of effects after each round of additions.
    """
    return _Beam(rng, progress, found).grow(rescale(state))


@dataclass(eq=False)
class _Beam:
    """Lists of effects that grow side by side.

    Args:
        rng: generator of synthetic noise.
        progress: bar that moves with every screened entry and names the effects found.
        found: called with the best list of effects after each round of additions.
        seen: names of the effects of each list so far.
        first: what could be added to the first list.
    """

    rng: np.random.Generator
    progress: LoopBar
    found: Callable[[SearchState], object]
    seen: set[frozenset[str]] = field(default_factory=set)
    first: Additions | None = None

    def grow(self, state: SearchState) -> SearchState:
        """Adds effects to a list until none of the lists grows further; returns the simplest of the best ones."""
        self.seen.add(_names(state))
        beam, complete, rounds = [state], [], 0
        while True:
            grown = [self._with_one_more(one) for one in beam]
            complete += [one for one, more in grown if not more]
            beam, rounds = [each for _, more in grown for each in more], rounds + 1
            if rounds == 2 and self.first is not None and not any(one.exact for one in beam):
                to_beat = min(self.first.state.screened_loss(one.fit.effects) for one in [*complete, *beam])
                beam += self._put_in(pairs_by_prediction(self.first, self.seen, to_beat, self.rng, self.progress.check))
            if not beam:
                return _simplest_of_best(complete)
            exact = [one for one in beam if one.exact]
            lists = [min(exact, key=_size)] if exact else _closest([*complete, *beam])
            self.progress.show_found(lists[0].entries)
            self.found(lists[0])
            if exact:
                return lists[0]
            beam, complete = ([one for one in lists if one in which] for which in (beam, complete))

    def _with_one_more(self, state: SearchState) -> tuple[SearchState, list[SearchState]]:
        """The state with the entries that were tried, and those with one set of effects more, if any passes."""
        if state.exact or number_of_effects(state) >= state.settings.max_effects:
            return state, []
        one_more = partial(self.progress.closer, SCREENING / max(1, len(state.others)))
        leads = screen(state.problem, state.fit.effects, state.others, state.windows.screened, one_more)
        added = additions(state, leads, self.rng, self.progress.check)
        self.first = self.first or added
        return added.state, self._put_in(added)

    def _put_in(self, possible: Additions) -> list[SearchState]:
        """The states with the additions that come close to the best one, without what they make redundant.

        Lists seen so far are left out.
        """
        state, grown = possible.state, []
        for addition in possible.near:
            added = state.with_found(addition.entries, addition.fit)
            added = _remember_leads(added, possible.leads, added.entries[len(state.entries) :])
            added = rescale(reorder(eliminate(divided_where_shared_harms(added))))
            if not state.entries and not grown and added.entries:
                self.progress.show_found(added.entries)
                self.found(added)  # a first result, in case that the time does not suffice for the others
            self.progress.closer(ADDITION)
            if _names(added) not in self.seen:
                self.seen.add(_names(added))
                grown.append(added)
            if added.exact:
                break
        return grown


def _names(state: SearchState) -> frozenset[str]:
    return frozenset(entry.name for entry in state.entries)


def _closest(states: Sequence[SearchState]) -> list[SearchState]:
    """The states whose loss comes close to the lowest one, in ascending order of their loss.

    The losses are compared with residuals scaled by what the best list leaves. Scaled by their size before the first
    effect, the residuals would hardly show what the last effect changes. Of lists with nearly equal losses, the one
    with the fewest parameters is kept: one friction for both joints, not the same friction for each.
    """
    means = [float(losses.mean()) for losses in comparable_losses(states)]
    near = [pair for pair in zip(means, states, strict=True) if pair[0] <= BEAM_LOSS * min(means)]
    near.sort(key=lambda pair: (_size(pair[1])[0], pair[0]))
    kept = sorted(distinct(near, itemgetter(0), SAME_FIT), key=itemgetter(0))
    return [state for _, state in kept[:BEAM_WIDTH]]


def _simplest_of_best(states: Sequence[SearchState]) -> SearchState:
    """Of the states that are as good as the one with the lowest loss, the one with the fewest parameters."""
    if len(states) == 1:
        return states[0]
    losses = comparable_losses(states)
    lowest, best = min(zip(losses, states, strict=True), key=lambda pair: pair[0].mean())
    as_good = [one for one, loss in zip(states, losses, strict=True) if not _is_beaten(one, loss, best, lowest)]
    return min(as_good, key=_size)


def is_beaten_by(state: SearchState, other: SearchState) -> bool:
    """Whether another list of effects, in the same windows, explains the selection part significantly better."""
    mine, its = comparable_losses([state, other])
    return bool(its.mean() < mine.mean()) and _is_beaten(state, mine, other, its)


def _is_beaten(state: SearchState, loss: np.ndarray, best: SearchState, lowest: np.ndarray) -> bool:
    """Whether a list's loss is significantly higher than that of the best one.

    If the best list has more parameters, each of them must also contribute the share that an added effect must.
    """
    level = state.settings.level
    if state.p_value(loss, lowest) > level:
        return False
    more = _size(best)[0] - _size(state)[0]
    without, with_them = (state.first.selection_loss(one.fit.effects) for one in (state, best))
    return more <= 0 or matters(state.first_loss, without, with_them, more * state.min_share)


def comparable_losses(states: Sequence[SearchState]) -> list[np.ndarray]:
    """Losses of the selection windows, (W) for each state, with residuals scaled by what the best state leaves."""
    best = min(states, key=lambda one: one.first.selection_loss(one.fit.effects))
    return [best.selection_losses(one.fit.effects) for one in states]


def _size(state: SearchState) -> tuple[int, int]:
    """Number of fitted parameters, and how unusual the effects are."""
    free = sum(len(free_parameters(entry)) for entry in state.entries)
    return free, sum(map(surprise, state.fit.effects))


def _remember_leads(state: SearchState, leads: Sequence[Lead], added: Sequence) -> SearchState:
    """Keeps the leads as rivals of the added entries, and each entry's best trial for later screenings."""
    rivals = {**state.rivals, **{entry.name: leads for entry in added}}
    narrowed = {lead.entry.name: replace(lead.entry, trials=(dict(lead.trial),)) for lead in leads}
    catalogue = tuple(narrowed.get(entry.name, entry) for entry in state.catalogue)
    return replace(state, rivals=rivals, catalogue=catalogue)
