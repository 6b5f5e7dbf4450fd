"""Drops effects that a set does not need, and replaces others by better or more usual ones."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace
from itertools import chain

from torchrl_h2o.effects import is_negligible
from torchrl_h2o.likelihood import Difference
from torchrl_h2o.residuals.elements import all_elements
from torchrl_h2o.residuals.gains import OF_JOINTS
from torchrl_h2o.residuals.ground import GROWN, Found, Ground, kind_of
from torchrl_h2o.residuals.grow import (
    ALIKE,
    Candidates,
    advantage,
    choices,
    gains_beside,
    is_preferred,
    is_usable,
    most_usual,
    with_one_more,
)
from torchrl_h2o.residuals.refit import variables_of, with_values
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.sweep import Direction

SURE = 3.0  # multiple of the evidence that an effect needs, beyond which an estimate of it is enough
SWAPS = 4  # largest number of effects that are replaced by others
FOLLOWED = 3  # sets that explain the data as well, from which the search goes on


def prune(ground: Ground, found: Found) -> Found:
    """Drops effects without which the rows are predicted as well, those first that are estimated to matter least.

    What several joints or motors have, such as friction, is dropped on all of them or on none: they resemble each
    other, and the log says little about some of them.
    """
    before, kept = found, set[frozenset[str]]()
    pairs = zip(found.entries, found.effects, strict=True)
    if idle := {entry.name for entry, effect in pairs if is_negligible(effect, entry.trials)}:
        found = ground.found(*found.without(idle))
    while (fewer := _smaller(ground, found, kept)) is not None:
        found = fewer
    return found if found is before else ground.fitted(found.entries, found.effects)


def _smaller(ground: Ground, found: Found, kept: set[frozenset[str]]) -> Found | None:
    """The set without the first kind of effects that the rows do not need; each that was tried is added to ``kept``."""
    part = ground.fit_part(found.effects)
    variables = variables_of(part, found.entries, found.effects)
    gains = gains_beside(part, found, found.slopes)
    tried = []
    for names in _of_each_kind(found, ground.simulation):
        if names not in kept:
            dropped = [index for index, entry in enumerate(found.entries) if entry.name in names]
            tried.append((names, *gains.readjusted(dropped, variables)))
    for names, moves, _ in sorted(tried, key=lambda one: one[2]):
        kept.add(names)
        entries, effects = found.without(names)
        if gains.evidence_for(moves) > SURE * ground.needed(found, Found(entries, effects, found.scores)):
            continue
        readjusted = replace(found, effects=with_values(found.effects, variables, moves))
        slopes = gains.slopes[:, [found.entries[one.effect].name not in names for one in variables]]
        try:
            fewer = ground.sketched(part, *readjusted.without(names), GROWN, slopes)
        except ValueError:  # the model rejects the others alone
            continue
        if not ground.adds(found, fewer):
            return fewer
    return None


def _of_each_kind(found: Found, simulation: Simulation) -> list[frozenset[str]]:
    """Names of the entries of each kind of effects; of those that overlap, such as on both feet and on a foot, each."""
    acting = [{(kind_of(one), index) for index in all_elements(one, simulation)} for one in found.effects]
    times, kinds = Counter(chain.from_iterable(acting)), dict[Hashable, set[str]]()
    for entry, effect, own in zip(found.entries, found.effects, acting, strict=True):
        overlaps = any(times[one] > 1 for one in own)
        kinds.setdefault(entry.name if overlaps else kind_of(effect), set()).add(entry.name)
    return [frozenset(names) for names in kinds.values()]


def replaced(
    ground: Ground, found: Found, directions: Sequence[Direction], advance: Callable[[], object]
) -> tuple[Found, list[list[Found]]]:
    """Replaces effects by better or more usual ones, and lists for each effect those that explain the data as well.

    A set that explains the data as well as the one found is as good a place to go on from. So the other effects of the
    best of these sets are tried on other joints, motors or geoms. Two effects may be wrong together, such as a weak
    motor and the friction of one wheel in place of a heavy body and the friction of both.
    """
    for swaps_left in reversed(range(SWAPS + 1)):
        better, alike = _rivals(ground, found, directions, advance, bool(swaps_left))
        if not better and swaps_left:
            better = _beyond(ground, found, alike, directions, advance)
        if not better:
            break
        found = prune(ground, most_usual(better))
    return found, alike


def _rivals(
    ground: Ground, found: Found, directions: Sequence[Direction], advance: Callable[[], object], may_swap: bool
) -> tuple[list[Found], list[list[Found]]]:
    """Sets that are better by another effect in an effect's place, and for each effect those that are as good.

    The same effect on each of several motors or bodies is replaced on all of them, and terms of a force one by one.
    Friction, damping and rotors of several joints stay, because every joint has them. The better sets are those of the
    first effect that has such; there are none unless ``may_swap``.
    """
    alike: dict[str, list[Found]] = {entry.name: [] for entry in found.entries}
    for kind, names in _by_kind(found).items():
        advance()
        if len(names) > 1 and kind in OF_JOINTS:
            continue
        fewer = ground.fitted(*found.without(names))
        candidates = Candidates.of(ground, fewer, directions)
        others = _alike(ground, found, fewer, with_one_more(ground, candidates, instead_of=found))
        if not others:  # two effects say no more than one that explains the data as well
            pairs = with_one_more(ground, candidates, instead_of=found, pairs=True)
            others = _alike(ground, found, fewer, pairs)
        if may_swap and (better := _better(ground, others, found, directions)):
            return better, list(alike.values())
        alike[min(names)] = sorted(others, key=lambda one: -one.scores.mean())
    return [], list(alike.values())


def _beyond(
    ground: Ground,
    found: Found,
    alike: Sequence[Sequence[Found]],
    directions: Sequence[Direction],
    advance: Callable[[], object],
) -> list[Found]:
    """Better sets than the one found: those that explain the data as well, with an effect on other elements."""
    single = [one for one in chain.from_iterable(alike) if len(one.entries) >= len(found.entries)]
    for rival in sorted(single, key=lambda one: -one.scores.mean())[:FOLLOWED]:
        kinds = _by_kind(rival).values()
        for entry, effect in zip(rival.entries, rival.effects, strict=True):
            elsewhere = [
                one for one in directions if type(one.entry.effect) is type(effect) and one.entry.name != entry.name
            ]
            if elsewhere and entry.name in found.names and {entry.name} in kinds:
                advance()
                fewer = ground.found(*rival.without({entry.name}))
                candidates = Candidates.of(ground, fewer, elsewhere)
                others = _alike(ground, rival, fewer, with_one_more(ground, candidates, instead_of=rival))
                if better := _better(ground, others, found, directions):
                    return better
    return []


def _by_kind(found: Found) -> dict[Hashable, set[str]]:
    """Names of the entries of each kind of effects."""
    kinds = dict[Hashable, set[str]]()
    for entry, effect in zip(found.entries, found.effects, strict=True):
        kinds.setdefault(kind_of(effect), set()).add(entry.name)
    return kinds


def _better(ground: Ground, others: Sequence[Found], found: Found, directions: Sequence[Direction]) -> list[Found]:
    """Those of other sets that may take the place of the one found."""
    return [one for one in others if is_preferred(one, found) and _is_worth_it(ground, one, found, directions)]


def _alike(ground: Ground, found: Found, fewer: Found, sketched: Sequence[Found]) -> list[Found]:
    """Of sets that explain at least half of what an effect explains, those that explain as much once they are fitted.

    A more usual set may explain less, by what the effect needs for being unusual.

    Args:
        ground: where sets are compared.
        found: the set with the effect.
        fewer: the set without it.
        sketched: the others.
    """
    half = 0.5 * (found.scores - fewer.scores).mean()
    present = dict(zip((entry.name for entry in found.entries), found.effects, strict=True))
    fitted = []
    for one in sketched:
        if (one.scores - fewer.scores).mean() > half:
            # what explains the data as well leaves the other effects as they are
            kept = [present.get(entry.name, effect) for entry, effect in zip(one.entries, one.effects, strict=True)]
            try:
                best = max(one, ground.found(one.entries, kept), key=lambda each: each.scores.mean())
            except ValueError:  # the model rejects these values together
                best = one
            fitted.append(ground.fitted(best.entries, best.effects))
    return [
        one
        for one in fitted
        if is_usable(ground, one, fewer)
        and (Difference(found.scores - one.scores).evidence < ALIKE or advantage(found, one) < ALIKE)
    ]


def _is_worth_it(ground: Ground, other: Found, found: Found, directions: Sequence[Direction]) -> bool:
    """Whether a set with more effects predicts better by what the best of many needs; others need not."""
    among = len({one.entry.name for one in directions})
    return len(other.entries) <= len(found.entries) or ground.adds(other, found, choices(among, other, found))
