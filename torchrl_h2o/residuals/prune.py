"""Drops effects that a set does not need, and replaces others by better or more usual ones."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

from torchrl_h2o.effects import is_negligible
from torchrl_h2o.residuals.gains import Gains
from torchrl_h2o.residuals.ground import GROWN, Found, Ground, kind_of
from torchrl_h2o.residuals.grow import ALIKE, Candidates, gains_beside, is_preferred, most_usual, with_one_more
from torchrl_h2o.residuals.refit import Variable, variables_of, with_values
from torchrl_h2o.residuals.score import Difference, Predictions
from torchrl_h2o.residuals.sweep import Direction

SURE = 3.0  # multiple of the evidence that an effect needs, beyond which an estimate of it is enough
MOST_KEPT = 3  # effects that were needed when they were dropped, after which no more are
SWAPS = 4  # largest number of effects that are replaced by others


def prune(ground: Ground, found: Found) -> Found:
    """Drops effects without which the rows are predicted as well, the least needed ones first."""
    before, kept = found, set[str]()
    pairs = zip(found.entries, found.effects, strict=True)
    if idle := {entry.name for entry, effect in pairs if is_negligible(effect, entry.trials)}:
        found = ground.found(*found.without(idle))
    found = _without_needless_kinds(ground, found)
    while found.names - kept and len(kept) < MOST_KEPT:
        linear = _Linear.about(ground, found)
        estimates = [one for one in linear.estimates if one[0] not in kept]
        cost = {name: ground.needed(found, Found(*found.without({name}), found.scores)) for name, _ in estimates}
        weak = [name for name, estimate in estimates if estimate < 0.5 * cost[name]]
        if not weak and (open_ := [name for name, estimate in estimates if estimate < SURE * cost[name]]):
            weak = open_[:1]
        count = len(weak)
        while count:
            fewer = linear.without(ground, weak[:count])
            if fewer is not None and not ground.adds(found, fewer):
                found = fewer
                break
            count //= 2
        else:
            if not weak:
                break
            kept.add(weak[0])
    return found if found is before else ground.fitted(found.entries, found.effects)


def _without_needless_kinds(ground: Ground, found: Found) -> Found:
    """Drops an effect on all of its joints or motors if the rows are predicted as well without it."""
    for kind in dict.fromkeys(map(kind_of, found.effects)):
        same = {e.name for e, effect in zip(found.entries, found.effects, strict=True) if kind_of(effect) == kind}
        if len(same) > 1:
            fewer = _Linear.about(ground, found).without(ground, same)
            if fewer is not None and not ground.adds(found, fewer):
                found = fewer
    return found


@dataclass(frozen=True, eq=False)
class _Linear:
    """A set with the changes of the errors by its values.

    Args:
        found: the set.
        part: predictions on the rows for fits.
        variables: its values.
        gains: the changes.
    """

    found: Found
    part: Predictions
    variables: Sequence[Variable]
    gains: Gains

    @classmethod
    def about(cls, ground: Ground, found: Found) -> _Linear:
        part = ground.fit_part(found.effects)
        variables = variables_of(part, found.entries, found.effects)
        return cls(found, part, variables, gains_beside(part, found, found.slopes))

    @property
    def estimates(self) -> list[tuple[str, float]]:
        """Effects in the order in which they may be dropped, with the estimated evidence for each."""
        order = self.gains.least_needed(self.variables)
        return [(self.found.entries[index].name, evidence) for index, evidence in order]

    def without(self, ground: Ground, names: Collection[str]) -> Found | None:
        """The set without some effects, fitted from readjusted values; None if the model rejects the others alone."""
        dropped = [index for index, entry in enumerate(self.found.entries) if entry.name in names]
        moves, _ = self.gains.readjusted(dropped, self.variables)
        effects = with_values(self.found.effects, self.variables, moves)
        slopes = self.gains.slopes[:, [one.effect not in dropped for one in self.variables]]
        try:
            return ground.sketched(self.part, *replace(self.found, effects=effects).without(names), GROWN, slopes)
        except ValueError:
            return None


def replaced(
    ground: Ground, found: Found, directions: Sequence[Direction], advance: Callable[[], object]
) -> tuple[Found, list[list[Found]]]:
    """Replaces effects by better or more usual ones, and lists for each effect those that explain the data as well.

    The same effect on each of several joints or motors stays; terms of a force are replaced one by one.
    """
    alike: list[list[Found]] = []
    swaps = 0
    while len(alike) < len(found.entries):
        advance()
        entry, effect = found.entries[len(alike)], found.effects[len(alike)]
        if sum(kind_of(other) == kind_of(effect) for other in found.effects) > 1:
            alike.append([])
            continue
        fewer = ground.found(*found.without({entry.name}))
        candidates = Candidates.of(ground, fewer, directions)
        sketched = with_one_more(ground, candidates, rival=entry.name)
        sketched += with_one_more(ground, candidates, [frozenset({entry.name})], pairs=True)
        half = 0.5 * (found.scores - fewer.scores).mean()
        fitted = [
            ground.fitted(one.entries, one.effects) for one in sketched if (one.scores - fewer.scores).mean() > half
        ]
        others = [one for one in fitted if Difference(found.scores - one.scores).evidence < ALIKE]
        better = [one for one in others if is_preferred(one, found) and _is_worth_it(ground, one, found, directions)]
        if better and swaps < SWAPS:
            found, alike, swaps = most_usual(better), [], swaps + 1
        else:
            alike.append(sorted(others, key=lambda one: -one.scores.mean()))
    return found, alike


def _is_worth_it(ground: Ground, other: Found, found: Found, directions: Sequence[Direction]) -> bool:
    """Whether a set with more effects predicts better by what the best of many needs; others need not."""
    added = len(other.entries) - len(found.entries)
    return added <= 0 or ground.adds(other, found, len({one.entry.name for one in directions}) ** (added + 1))
