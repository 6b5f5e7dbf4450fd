"""Searches the set of effects with the best score: sweeps, linear algebra, refits of the best few sets."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TypeVar

import numpy as np

from torchrl_h2o.effects import (
    CatalogueEntry,
    Effect,
    JointFrictionLoss,
    LoadFriction,
    ResidualForce,
    StribeckFriction,
    is_negligible,
)
from torchrl_h2o.effects.catalogue.entry import entry_of
from torchrl_h2o.effects.catalogue.plausibility import surprise
from torchrl_h2o.effects.model.joint import LOCKED, JointRange
from torchrl_h2o.likelihood import ENOUGH, Difference
from torchrl_h2o.residuals.elements import all_elements, elements
from torchrl_h2o.residuals.explanation import Alternative, Explanation, Part, Tried
from torchrl_h2o.residuals.forces.candidates import force_entry
from torchrl_h2o.residuals.gains import summed
from torchrl_h2o.residuals.ground import GROWN, NATS_OF_SURPRISE, Found, Ground, kind_of
from torchrl_h2o.residuals.grow import Candidates, gains_beside, grow, is_preferred, with_force
from torchrl_h2o.residuals.intervals import interval
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.progress import EFFECTS, FORCES, OTHERS, LoopBar, OutOfTimeError
from torchrl_h2o.residuals.prune import prune, replaced
from torchrl_h2o.residuals.refit import SetFit, fit_set
from torchrl_h2o.residuals.report.contents import SearchStep
from torchrl_h2o.residuals.report.words import effect_words
from torchrl_h2o.residuals.score import Predictions
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.sweep import Direction, alone_on, sweep

T = TypeVar("T")

RESWEPT = 64  # entries of the largest estimated gain, which are simulated again in later sweeps
NEUTRAL = 0.1  # half-widths from neutral up to which effects are left out together
MOST_LEFT_OUT = 3  # fits after which effects are left out whose intervals hold their neutral values
SWEEPS = 6  # largest number of sweeps


#: the test by which the search for effects stops
STOP_TEST = (
    "log density of the rows, predicted 1, 2, 4, ... rows ahead: paired over blocks of rows, a further effect must "
    f"raise it by a likelihood ratio of {math.exp(ENOUGH):.0f} in all rows, more if it is unusual or the best of many, "
    "less if several joints have it, and must raise it in the rows that chose no value, too"
)


def search(
    simulation: Simulation,
    measured: Measured,
    catalogue: Sequence[CatalogueEntry],
    *,
    progress: LoopBar,
    known: Sequence[Effect] = (),
    so_far: Callable[[Explanation], object] = lambda found: None,
) -> Explanation:
    """Searches the effects with which a simulator predicts the data best.

    Args:
        simulation: the simulator.
        measured: the data.
        catalogue: effects that the simulator may lack; random ones are left out, because noise is part of the score.
            Forces that are none of them are tried as well, but need more evidence.
        progress: bar that shows how far the search is.
        known: effects of the catalogue from which the search begins.
        so_far: called with each better explanation.

    Returns:
        The explanation, with the values fitted to the rows for fits and for selection; the one so far if the time of
        ``progress`` is up.

    Raises:
        OutOfTimeError: if the time of ``progress`` is up before there is a first result.
    """
    tried: dict[str, Tried] = {}
    latest = [known_set(catalogue, known)]

    steps: list[SearchStep] = []

    def better(found: Found, before: Found) -> None:
        if found.names != before.names:
            steps.append(_step(found, before, simulation))
        latest.append(found)
        if found.entries:
            progress.has_result()
        progress.show_found(found.entries)
        so_far(replace(_explanation(found), steps=tuple(steps)))

    ended_in, unseen, alike = None, (), []
    progress.stage(EFFECTS)
    grounds = [Ground.of(simulation, measured, latest[0].effects)]
    try:
        alike, unseen = _searched(grounds, measured, latest[0], catalogue, progress, better, tried)
    except OutOfTimeError as end:
        ended_in = str(end)
    found, alike = disjoint(latest[-1], alike, catalogue, simulation)
    progress.begin_last_fit(bool(found.entries))
    try:
        found, alike = without_endless_rest(grounds[-1], found, alike, catalogue)
        explanation = _explanation(*with_intervals(grounds[-1], found, alike))
    except OutOfTimeError as end:
        explanation, ended_in = _explanation(found), ended_in or str(end)
    left = [one for name, one in tried.items() if name not in found.names]
    left.sort(key=lambda one: -one.evidence)
    return replace(explanation, tried=tuple(left), unseen=unseen, steps=tuple(steps), ended_in=ended_in)


def _step(found: Found, before: Found, simulation: Simulation) -> SearchStep:
    """A step of the search in words, with what it gained."""
    difference = Difference(found.scores - before.scores)
    put_in, dropped = (
        tuple(effect_words(effect, simulation.names) for effect in one.without(other.names)[1])
        for one, other in ((found, before), (before, found))
    )
    return SearchStep(put_in, dropped, difference.mean / len(simulation.state_map.names), difference.evidence)


def known_set(catalogue: Sequence[CatalogueEntry], known: Sequence[Effect]) -> Found:
    """The set from which a search begins: effects of the catalogue, and each term of a force by itself."""
    pairs: list[tuple[CatalogueEntry, Effect]] = []
    for effect in known:
        if isinstance(effect, ResidualForce):
            pairs += [force_entry(ResidualForce((term,))) for term in effect.terms]
        elif not effect.random and (entry := entry_of(effect, catalogue)) is not None:
            pairs.append((entry, effect))
    return Found(tuple(entry for entry, _ in pairs), tuple(effect for _, effect in pairs), np.zeros(0))


def _searched(
    grounds: list[Ground],
    measured: Measured,
    found: Found,
    catalogue: Sequence[CatalogueEntry],
    progress: LoopBar,
    better: Callable[[Found, Found], object],
    tried: dict[str, Tried],
) -> tuple[list[list[Found]], tuple[Effect, ...]]:
    """Sweeps and grows, then drops and replaces, until nothing changes; hands each better set to ``better``.

    The ground of each sweep is added to ``grounds``, so that it is known when the time is up.
    """
    every = [entry for entry in catalogue if not entry.effect.random]
    entries, directions, alike, unseen = every, [], [], ()
    settled: frozenset[str] | None = None
    ground = grounds[-1]
    for number in range(SWEEPS):
        explained = number > 0 and ground.leaves_little(found)
        if not explained:
            if number:
                ground, found = grounds[-1].near(found, measured)
                grounds.append(ground)
            found = ground.fitted(found.entries, found.effects)
            if number > 1:
                best = Candidates.of(ground, found, directions).leads[:RESWEPT]
                chosen = found.names.union(*(lead.names for lead in best))
                entries = [entry for entry in every if entry.name in chosen]
            rough = ground.rough(found.effects)
            directions = sweep(rough, entries, found.effects, partial(progress.closer, 0.5 / max(1, len(entries))))
            if not number and not found.entries:
                unseen = _unseen(ground, rough, every, directions)
        before = found.names
        if not explained:
            found = grow(ground, found, directions, better, tried)
        if found.names == before and not explained:
            progress.stage(FORCES)
            found = with_force(ground, found, every, better)
            if before and found.names != before:  # a force alone may explain what effects were found for
                alone = with_force(ground, ground.found((), ()), every, lambda *_: None)
                if alone.entries and is_preferred(alone, found):
                    better(alone, found)
                    found = alone
        if found.names == before:
            if found.names == settled:
                break
            progress.stage(OTHERS)
            pruned = prune(ground, found)
            better(pruned, found)
            found, alike = replaced(ground, pruned, directions, lambda: progress.closer(0.05))
            better(found, pruned)
            settled = found.names
            if settled == before:
                break
    return alike if found.names == settled else [], () if found.entries else unseen


def _unseen(
    ground: Ground,
    rough: Predictions,
    entries: Sequence[CatalogueEntry],
    directions: Sequence[Direction],
) -> tuple[Effect, ...]:
    """Effects at their largest trials that these data would not show, the first of each kind before the others."""
    gains = gains_beside(rough, Found((), (), np.zeros(0)))
    seen: dict[str, float] = {entry.name: 0.0 for entry in entries}
    largest: dict[str, Effect] = {entry.name: entry.starts[-1] for entry in entries}
    blocks = len(ground.base.selection.blocks) / len(rough.blocks)
    for direction in directions:
        if isinstance(direction.entry.effect, JointRange) and direction.trial["scale"] <= LOCKED:
            continue  # any motion shows that a joint is not locked
        evidence = blocks * gains.evidence_if_there(direction)
        if evidence > seen[direction.entry.name]:
            seen[direction.entry.name] = evidence
            largest[direction.entry.name] = direction.entry.effect.with_parameters(direction.trial)
    needed = {name: NATS_OF_SURPRISE * surprise(effect) + ENOUGH for name, effect in largest.items()}
    missed = sorted((name for name in seen if seen[name] < needed[name]), key=lambda name: -seen[name])
    effects = [largest[name] for name in missed]
    first = {type(effect): effect for effect in reversed(effects)}
    return tuple(sorted(effects, key=lambda effect: effect is not first[type(effect)]))


def disjoint(
    found: Found, alike: Sequence[Sequence[Found]], catalogue: Sequence[CatalogueEntry], simulation: Simulation
) -> tuple[Found, Sequence[Sequence[Found]]]:
    """A set and its alternatives, in which one effect on each element stands for a shared one beside further ones.

    *Stiffness of both feet + 60, stiffness of the back foot + 60* becomes 120 for the back foot and 60 for the front
    foot. A set that would grow by this stays as it is.
    """
    alone = alone_on(catalogue, simulation, all_elements)
    for entry, effect in zip(found.entries, found.effects, strict=True):
        own = [alone.get((type(effect), index)) for index in all_elements(effect, simulation)]
        further = {one.name for one in own if one is not None} & found.names - {entry.name}
        if len(entry.fitted) == 1 and further and None not in own and len(own) <= 1 + len(further):
            present = dict(zip((one.name for one in found.entries), found.effects, strict=True))
            singles = [one for one in own if one is not None]
            shared = {name: effect.parameters[name].value for name in entry.fitted}
            values = [one.effect.with_parameters(shared) for one in singles]
            values = [
                summed(value, present[one.name]) if one.name in further else value
                for one, value in zip(singles, values, strict=True)
            ]
            left_out = further | {entry.name}
            kept = found.without(left_out)
            sets = [one for own_entry, one in zip(found.entries, alike, strict=False) if own_entry.name not in left_out]
            entries, effects = (*kept[0], *singles), (*kept[1], *values)
            apart = replace(found, entries=entries, effects=effects, slopes=None)
            return apart, [*sets, *([] for _ in singles)] if alike else ()
    return found, alike


def without_endless_rest(
    ground: Ground, found: Found, alike: Sequence[Sequence[Found]], catalogue: Sequence[CatalogueEntry]
) -> tuple[Found, Sequence[Sequence[Found]]]:
    """A set and its alternatives, with dry friction in the place of friction at rest where that explains as much.

    Friction at rest that no measured motion leaves is dry friction, which is more usual.
    """
    for entry, effect in zip(found.entries, found.effects, strict=True):
        if not isinstance(effect, StribeckFriction):
            continue
        constant: tuple[Effect, ...] = (
            JointFrictionLoss(effect.torque, effect.joints),
            LoadFriction(effect.share, effect.weight, effect.joints),
        )
        offered = [(own, one) for one in constant if (own := entry_of(one, catalogue)) is not None]
        if len(offered) < len(constant):
            continue
        kept = {one.name: (one, present) for one, present in zip(found.entries, found.effects, strict=True)}
        others = dict(zip(kept, alike, strict=False))
        del kept[entry.name]
        for own, one in offered:
            kept[own.name] = own, summed(one, kept[own.name][1]) if own.name in kept else one
        usual = ground.fitted(*zip(*kept.values(), strict=True))
        if is_preferred(usual, ground.found(found.entries, found.effects)):
            found, alike = usual, [others.get(name, []) for name in kept] if alike else alike
    return found, alike


def with_intervals(
    ground: Ground, found: Found, alike: Sequence[Sequence[Found]]
) -> tuple[Found, SetFit, Sequence[Sequence[Found]]]:
    """A set fitted to the rows for fits and for selection, the fit with its intervals, and the set's alternatives.

    Of several logs, an interval is that of the value in another log of the machine: it holds the scatter between logs.

    Every horizon counts alike in this fit: values hold for simulations of any length, and small errors in the many
    short windows do not outweigh large ones far ahead. Effects whose interval holds their neutral value are left out,
    the least certain ones first, while there is time. What several joints or motors have, such as friction, is left out
    on all of them or on none, because they resemble each other. Values within rounding of neutral are left out by
    themselves.
    """
    effects = found.effects
    for is_last in (False, True) if effects else (True,):
        model = ground.model(effects)
        both = (replace(part, floor=None, counts=()) for part in (model.fit, model.selection))
        parts = [part.of_simulation(ground.simulation) for part in both]
        fit = fit_set(parts, found.entries, effects, most_steps=GROWN, intervals=is_last)
        effects = fit.effects
    for _ in range(MOST_LEFT_OUT):
        kinds = [kind_of(effect) if elements(effect, ground.simulation) else effect for effect in fit.effects]
        certain: dict[Hashable, float] = {}
        for kind, effect, half in zip(kinds, fit.effects, fit.half_widths, strict=True):
            certain[kind] = max(_certainty(effect, half), certain.get(kind, 0.0))
        sizes = [certain[kind] for kind in kinds]
        least = max(NEUTRAL, min(sizes, default=math.inf))
        idle = {
            entry.name
            for entry, effect, size in zip(found.entries, fit.effects, sizes, strict=True)
            if (size <= least and size < 1.0) or is_negligible(effect, entry.trials)
        }
        if not idle:
            break
        fewer = Found(*replace(found, effects=fit.effects).without(idle), found.scores)
        kept = [entry.name not in idle for entry in found.entries for _ in entry.fitted]
        slopes = [own[:, kept] for own in fit.slopes]
        try:
            refit = fit_set(parts, fewer.entries, fewer.effects, most_steps=GROWN, intervals=True, slopes=slopes)
        except OutOfTimeError:
            break
        alike = [
            [Found(*one.without(idle), one.scores) for one in sets]
            for entry, sets in zip(found.entries, alike, strict=False)
            if entry.name not in idle
        ]
        found, fit = fewer, refit
    return replace(found, effects=fit.effects), fit, alike


def _certainty(effect: Effect, half_widths: Mapping[str, float]) -> float:
    """Largest distance of an effect's amounts from neutral, in half-widths of their intervals.

    Infinite for an effect without an interval, or with a limit, which has no finite neutral value.
    """
    certain = {name: half for name, half in half_widths.items() if half > 0.0}
    values = {name: effect.parameters[name] for name in effect.amounts or half_widths if name in certain}
    return max((abs(one.value - one.neutral) / certain[name] for name, one in values.items()), default=math.inf)


def _explanation(found: Found, fit: SetFit | None = None, alike: Sequence[Sequence[Found]] = ()) -> Explanation:
    """The explanation by a set; the terms of forces are put together, at its end."""
    parts, forces = [], []
    for index, effect in enumerate(found.effects):
        half, in_logs = ({}, {}) if fit is None else (fit.in_another_log[index], fit.in_logs[index])
        ci95 = {name: interval(effect.parameters[name], width) for name, width in half.items()}
        if isinstance(effect, ResidualForce):
            forces.append((effect, ci95, in_logs))
            continue
        instead = [_alternative(other, found) for other in alike[index] if _is_one(other, found)] if alike else []
        parts.append(Part(effect, True, ci95, tuple(instead), in_logs))
    if forces:
        effects, intervals, each = zip(*forces, strict=True)
        terms = tuple(term for effect in effects for term in effect.terms)
        parts.append(Part(ResidualForce(terms), False, _of_terms(intervals), in_logs=_of_terms(each)))
    others = {other.names: other.effects for sets in alike for other in sets if not _is_one(other, found)}
    return Explanation(tuple(parts), others=tuple(others.values()))


def _of_terms(each: Sequence[Mapping[str, T]]) -> dict[str, T]:
    """What belongs to the parameters of single terms, by the parameters of the force with all these terms."""
    return {f"{name.rsplit('_', 1)[0]}_{i}": one for i, own in enumerate(each, start=1) for name, one in own.items()}


def _is_one(other: Found, found: Found) -> bool:
    """Whether a set has one other effect than the one found, and not the same on each of several joints."""
    return len(other.names - found.names) == 1


def _alternative(other: Found, found: Found) -> Alternative:
    (effect,) = other.without(found.names)[1]
    return Alternative(effect, tuple((one, {}) for one in other.effects))
