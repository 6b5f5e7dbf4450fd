"""Adds effects to a set: those of the catalogue that could gain most, then forces outside it."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchrl_h2o.effects import CatalogueEntry, Effect, ResidualForce, is_negligible
from torchrl_h2o.effects.catalogue.plausibility import is_outside
from torchrl_h2o.likelihood import ENOUGH, Difference
from torchrl_h2o.residuals.explanation import Tried
from torchrl_h2o.residuals.forces.candidates import force_candidates
from torchrl_h2o.residuals.gains import OF_JOINTS, Gains, Lead
from torchrl_h2o.residuals.ground import FITTED, GROWN, NATS_OF_SURPRISE, SKETCH, Found, Ground, kind_of
from torchrl_h2o.residuals.refit import FARTHEST, Variable, fit_set, slopes_of, variables_of, with_values
from torchrl_h2o.residuals.score import Predictions
from torchrl_h2o.residuals.sweep import Direction

TRIED = 16  # candidates of the largest estimated gain whose gain is then simulated
BEGUN = 8  # of these, the best that are fitted in one step
ALIKE = 3.0  # evidence, in nats, up to which two sets explain the data equally well
PART = 0.1  # share of an effect's gain that others must gain in its place before they are fitted
RENEWED = 8  # values by which derivatives are computed again beside a candidate
MOST_REFUSED = 9  # candidates that are refused one after another before none is added
FEW = 2  # effects that are added together as if they were one
MOST_TERMS = 6  # largest number of terms of a force outside the catalogue
MOST_EFFECTS = 80  # largest number of entries in a set

Set = tuple[tuple[CatalogueEntry, ...], tuple[Effect, ...]]


@dataclass(frozen=True, eq=False)
class Candidates:
    """What may be added to a set.

    Args:
        rough: predictions from start states filtered with the set, on which candidates are fitted.
        found: the set.
        gains: gains beside the set.
        variables: values of the set.
        leads: the best direction of each candidate, in descending order of the estimated gain.
        joints: friction, damping and rotors of all joints together.
    """

    rough: Predictions
    found: Found
    gains: Gains
    variables: Sequence[Variable]
    leads: Sequence[Lead]
    joints: Lead | None

    @classmethod
    def of(cls, ground: Ground, found: Found, directions: Sequence[Direction]) -> Candidates:
        """The candidates beside a set."""
        rough = ground.rough(found.effects)
        gains, variables = gains_beside(rough, found), variables_of(rough, found.entries, found.effects)
        leads, joints = best_of_each(gains.leads(directions)), gains.of_joints(directions)
        return cls(rough, found, gains, variables, leads, joints)

    def sizes(self, lead: Lead) -> list[Set]:
        """The set with a candidate at a few sizes, beside readjusted values and, at the first size, present ones."""
        moves, present = self.gains.moves_beside(lead), (self.found.entries, self.found.effects)

        def readjusted(factor: float) -> tuple[Effect, ...]:
            limited = np.clip(factor * moves, -FARTHEST, FARTHEST)
            return with_values(self.found.effects, self.variables, limited)

        return [
            *(lead.beside(*present, factor, readjusted(factor)) for factor in lead.factors),
            lead.beside(*present, 1.0),
        ]


def grow(
    ground: Ground,
    found: Found,
    directions: Sequence[Direction],
    advance: Callable[[Found, Found], object],
    tried: dict[str, Tried],
) -> Found:
    """Adds candidates, or two together, while the rows are predicted better; see :meth:`Ground.adds`.

    Args:
        ground: where sets are compared.
        found: the set.
        directions: the candidates.
        advance: called with each better set and the one before.
        tried: takes up each effect that was fitted, by name.
    """
    refused: set[frozenset[str]] = set()
    among = max(1, len({one.entry.name for one in directions}))
    candidates = Candidates.of(ground, found, directions)
    while len(found.entries) < MOST_EFFECTS:
        fitted = with_one_more(ground, candidates, refused) if len(refused) < MOST_REFUSED else []
        singly = bool(fitted)
        if not singly:  # no candidate suffices by itself
            fitted = with_one_more(ground, candidates, pairs=True)
        for one in fitted:
            _remember(tried, one, found)
        better = [one for one in fitted if ground.adds(one, found, choices(among, one, found))]
        if better:
            best = on_best_elements(better, [one for one in fitted if ground.agrees(one, found)], found)
            before, found, refused = found, ground.fitted(best.entries, best.effects), set()
            advance(found, before)
            if _is_many(best, before) or ground.leaves_little(found):  # many change how candidates change the errors
                break
            candidates = Candidates.of(ground, found, directions)
        elif singly:
            refused |= {one.names - found.names for one in fitted}
        else:
            break
    return found


def on_best_elements(better: Sequence[Found], fitted: Sequence[Found], before: Found) -> Found:
    """The most usual of better sets, or the best one that adds effects of the same kinds to other elements.

    Whether an effect is there is one question. On which joints, motors or geoms it acts is another. This one needs no
    evidence of its own, because the effect must act on some of them.

    Args:
        better: sets with enough evidence.
        fitted: further sets that may take their place.
        before: the set to which they add effects.
    """

    def added(one: Found) -> set[type]:
        return {type(effect) for effect in one.without(before.names)[1]}

    best = most_usual(better)
    return most_usual([best, *(one for one in fitted if added(one) == added(best))])


def choices(among: int, more: Found, less: Found) -> int:
    """Number of sets of which a larger one is the best.

    It is 1 for what each of several joints has. Friction, damping and rotors, which every joint has, are one choice.
    """
    added = more.without(less.names)[1]
    kinds = {*map(kind_of, added)}
    if _is_many(more, less) and len(kinds) < len(added):
        return 1
    return among ** (len(kinds - {*OF_JOINTS}) + bool(kinds & {*OF_JOINTS}))


def _is_many(more: Found, less: Found) -> bool:
    """Whether a set has an effect on each of several joints more than another: a choice among few kinds of effects."""
    return len(more.entries) > len(less.entries) + FEW


def _remember(tried: dict[str, Tried], more: Found, less: Found) -> None:
    """Keeps an effect that was fitted beside others, with its evidence."""
    added = [pair for pair in zip(more.entries, more.effects, strict=True) if pair[0].name not in less.names]
    if len(added) == 1 and not isinstance(added[0][1], ResidualForce):
        tried[added[0][0].name] = Tried(*added[0], Difference(more.scores - less.scores).evidence)


def with_force(
    ground: Ground, found: Found, catalogue: Sequence[CatalogueEntry], advance: Callable[[Found, Found], object]
) -> Found:
    """Adds terms of a force outside the catalogue while the rows are predicted better; see :meth:`Ground.adds`."""
    for _ in range(MOST_TERMS):
        starts = ground.model(found.effects).fit.starts
        rows, states = starts.of_rows
        sets = []
        for pairs in force_candidates(starts.record.simulation, starts.record.measured, states, rows, catalogue):
            new = [pair for pair in pairs if pair[0].name not in found.names]
            if new:
                entries, effects = zip(*new, strict=True)
                sets.append([((*found.entries, *entries), (*found.effects, *effects))])
        beside = Candidates.of(ground, found, ())
        fitted = _sketched(ground, beside, _best_simulated(beside.rough, sets))
        better = [one for one in fitted if ground.adds(one, found, max(1, len(sets)))]
        if not better:
            break
        best = most_usual(better)
        before, found = found, ground.fitted(best.entries, best.effects)
        advance(found, before)
    return found


def with_one_more(
    ground: Ground,
    candidates: Candidates,
    passed_over: Collection[frozenset[str]] = (),
    instead_of: Found | None = None,
    pairs: bool = False,
) -> list[Found]:
    """The set with each of the few best candidates, whose values are fitted in a few steps.

    Args:
        ground: where sets are compared.
        candidates: the candidates beside the set.
        passed_over: names of the entries of candidates that are not tried.
        instead_of: the set with another effect, which is not tried. Only candidates are fitted that gain at least the
            share ``PART`` of what it gains.
        pairs: whether to try two candidates together.
    """
    rough, found, joints = candidates.rough, candidates.found, candidates.joints
    least = 0.5 * ENOUGH * len(rough.blocks) / len(ground.base.fit.blocks)
    if instead_of is not None:
        passed_over = [*passed_over, instead_of.names - found.names]
    leads = [
        lead
        for lead in candidates.leads
        if lead.names - found.names not in passed_over and not lead.names <= found.names
    ]
    if instead_of is None or pairs:
        leads = [lead for lead in leads if lead.evidence > least]
    if pairs:
        leads = candidates.gains.pairs([lead for lead in leads if not _kinds(lead) & _kinds_of(found)])
    is_new = joints is not None and joints.names - found.names not in {frozenset(), *passed_over}
    if instead_of is None and not pairs and joints and is_new and joints.evidence > least:
        leads = [joints, *(lead for lead in leads if len(lead.names) == 1 or not lead.names <= joints.names)]
    bar = -math.inf
    if instead_of is not None:
        without = candidates.gains.score
        bar = without + PART * (_score(rough, instead_of.effects) - without)
    best = _best_simulated(rough, [candidates.sizes(lead) for lead in leads[:TRIED]], bar)
    return [one for one in _sketched(ground, candidates, best) if is_usable(ground, one, found)]


def _kinds(lead: Lead) -> set[type]:
    return {type(direction.entry.effect) for direction in lead.directions}


def _kinds_of(found: Found) -> set[type]:
    return {type(effect) for effect in found.effects}


def _best_simulated(rough: Predictions, candidates: Sequence[Sequence[Set]], bar: float = -math.inf) -> list[Set]:
    """The sets of the best candidates by their score, each at the best of its sizes, if it is above a bar.

    Other sizes than the first are simulated of those candidates alone that are among the best at it.
    """
    scored = [(_score(rough, sizes[0][1]), sizes[0], sizes[1:]) for sizes in candidates]
    scored.sort(key=lambda one: -one[0])
    for index, (score, first, others) in enumerate(scored[:BEGUN]):
        sizes = [(score, first), *((_score(rough, size[1]), size) for size in others)]
        scored[index] = (*max(sizes, key=lambda one: one[0]), ())
    scored.sort(key=lambda one: -one[0])
    return [one for score, one, _ in scored[:BEGUN] if score > bar]


def _score(rough: Predictions, effects: Sequence[Effect]) -> float:
    """Score with effects; minus infinity if the model rejects them together."""
    try:
        return rough.score(effects)
    except ValueError:
        return -math.inf


def _sketched(ground: Ground, candidates: Candidates, sets: Sequence[Set]) -> list[Found]:
    """The few best sets after one step of a fit, with their values fitted in a few more.

    Sets that the model rejects are left out. The derivatives by many values of the present set are not computed again
    where a set begins with its entries.
    """
    rough, present, begun = candidates.rough, candidates.found, []
    for entries, effects in sets:
        is_known = len(candidates.variables) > RENEWED and entries[: len(present.entries)] == present.entries
        known = [candidates.gains.slopes] if is_known else None
        try:
            begun.append((fit_set([rough], entries, effects, most_steps=1, slopes=known), entries))
        except ValueError:
            continue
    begun.sort(key=lambda one: -one[0].score)
    found = []
    for fit, entries in begun[:FITTED]:
        steps = GROWN if len(entries) > len(present.entries) + FEW else SKETCH
        found.append(replace(ground.sketched(rough, entries, fit.effects, steps - 1, fit.slopes[0]), slopes=None))
    return found


def gains_beside(part: Predictions, found: Found, slopes: np.ndarray | None = None) -> Gains:
    """Gains of candidates beside a set, whose values are readjusted; slopes are those by its values, if known."""
    errors = part.errors(found.effects)
    if found.entries and slopes is None:
        variables = variables_of(part, found.entries, found.effects)
        (slopes,) = slopes_of([part], found.effects, variables, [errors])
    return Gains.of(part, errors, slopes)


def best_of_each(leads: Sequence[Lead]) -> list[Lead]:
    """The best direction of each candidate, in descending order of the estimated gain."""
    best: dict[frozenset[str], Lead] = {}
    for lead in leads:
        best.setdefault(lead.names, lead)
    return list(best.values())


def is_usable(ground: Ground, found: Found, before: Found) -> bool:
    """Whether the one or two effects that a set has beyond another are possible and not negligible; True for more."""
    added = found.without(before.names)
    return len(added[0]) > FEW or not any(
        is_negligible(effect, entry.trials) or is_outside(effect, ground.simulation.model)
        for entry, effect in zip(*added, strict=True)
    )


def most_usual(sets: Sequence[Found]) -> Found:
    """The best set, or the most usual and smallest one of those over which it has no significant advantage."""
    best = max(sets, key=lambda one: one.scores.mean())
    alike = [one for one in sets if advantage(best, one) < ALIKE]
    return min([best, *alike], key=lambda one: (*one.unusual, -one.scores.mean()))


def is_preferred(other: Found, found: Found) -> bool:
    """Whether a set has an advantage over another, or none, but fewer or more usual effects."""
    own = advantage(other, found)
    return own > ALIKE or (own > -ALIKE and other.unusual < found.unusual)


def advantage(one: Found, other: Found) -> float:
    """Evidence for a set against another, in nats, less what it needs for being more unusual."""
    evidence = Difference(one.scores - other.scores).evidence
    return evidence - NATS_OF_SURPRISE * (one.surprise - other.surprise)
