"""Searches the set of effects with the best score: sweeps, linear algebra, refits of the best few sets."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchrl_h2o.effects import CatalogueEntry, Effect, is_negligible
from torchrl_h2o.effects.catalogue.entry import entry_of
from torchrl_h2o.effects.catalogue.plausibility import is_outside, surprise
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.progress import EFFECTS, OTHERS, LoopBar, OutOfTimeError
from torchrl_h2o.residuals.refit import SetFit, fit_set, flat, slopes_of, variables_of
from torchrl_h2o.residuals.score import Difference, Model, Predictions, fitted_scales, scores
from torchrl_h2o.residuals.settings import DEFAULTS, LoopSettings
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.sweep import Direction, Gains, Lead, sweep
from torchrl_h2o.residuals.trace.families import elements
from torchrl_h2o.residuals.trace.fit import Fit
from torchrl_h2o.residuals.trace.outcome import Attempt, Trace

ROUGH_STEPS = 2560  # physics steps that are simulated for each candidate of a sweep and in first fits
ROUGH_ROWS = 1024  # rows beyond which these are not more
TRIED = 10  # candidates of the largest estimated gain whose gain is then simulated
FITTED = 4  # of these, the best whose values are fitted
SKETCH = 3  # steps of such a fit
GROWN = 5  # steps of the fit of a set after an effect was added
SWEEPS = 5  # largest number of sweeps
NATS_OF_EFFECT = 4.6  # evidence, in nats, that an effect needs before it is believed: the logarithm of 100
NATS_OF_SURPRISE = 2.0  # evidence that an effect needs for each degree of surprise
ALIKE = 3.0  # evidence, in nats, up to which two sets explain the data equally well
EXACT = 1e-5  # median error, in spreads, of data that are explained up to rounding
SWAPS = 4  # largest number of effects that are replaced by others
MOST_EFFECTS = 40  # largest number of entries in a set


@dataclass(frozen=True, eq=False)
class Found:
    """A set of effects with its score.

    Args:
        entries: entries of the catalogue.
        effects: the effects with their values.
        scores: scores of the blocks for fits and of those for selection, (F + S).
    """

    entries: tuple[CatalogueEntry, ...]
    effects: tuple[Effect, ...]
    scores: np.ndarray

    @property
    def surprise(self) -> int:
        """How unusual the effects are in all."""
        return sum(map(surprise, self.effects))

    def without(self, index: int) -> tuple[tuple[CatalogueEntry, ...], tuple[Effect, ...]]:
        """Entries and effects without one of them."""
        return (*self.entries[:index], *self.entries[index + 1 :]), (*self.effects[:index], *self.effects[index + 1 :])


@dataclass(frozen=True, eq=False)
class Ground:
    """The models on which sets are compared: predictions from start states filtered with the present effects.

    Args:
        simulation: the simulator without effects.
        model: predictions for fits and for selection; effects are added to ``simulation``.
        rough: predictions of long windows in some of the blocks for fits.
    """

    simulation: Simulation
    model: Model
    rough: Predictions

    @classmethod
    def of(cls, simulation: Simulation, measured: Measured, effects: Sequence[Effect] = ()) -> Ground:
        """Filters the start states with effects."""
        model = Model.of(simulation.with_effects(*effects), measured)
        counts = model.fit.correlations(model.fit.errors())
        fit, selection = replace(model.fit, counts=counts), replace(model.selection, counts=counts)
        model = Model(fit, selection)
        if effects:
            model = Model(fit.of_simulation(simulation), selection.of_simulation(simulation))
        rows = min(ROUGH_ROWS, ROUGH_STEPS // simulation.frame_skip)
        rough = model.fit.starts.rough(max(8, rows // model.fit.blocks.steps))
        return cls(simulation, model, Predictions(rough))

    @property
    def num_fit(self) -> int:
        """Number of blocks for fits."""
        return len(self.model.fit.blocks)

    def found(self, entries: Sequence[CatalogueEntry], effects: Sequence[Effect]) -> Found:
        """A set with its scores."""
        return Found(tuple(entries), tuple(effects), self.model.scores(effects))

    def fitted(self, entries: Sequence[CatalogueEntry], effects: Sequence[Effect], steps: int) -> Found:
        """A set with its values fitted from the present ones."""
        return self.found(entries, fit_set([self.model.fit], entries, effects, most_steps=steps).effects)

    def sketched(self, entries: Sequence[CatalogueEntry], effects: Sequence[Effect]) -> Found:
        """A set with its values fitted to the rough predictions, in a few steps."""
        return self.found(entries, fit_set([self.rough], entries, effects, most_steps=SKETCH).effects)

    def rough_score(self, effects: Sequence[Effect]) -> float:
        """Mean score of the rough predictions."""
        errors = self.rough.errors(effects)
        return float(scores(self.rough, errors, fitted_scales(self.rough, errors)).mean())

    def adds(self, more: Found, less: Found, level: float) -> bool:
        """Whether a set predicts the rows for selection better than a smaller one, by more than its surprise."""
        difference = Difference(more.scores[self.num_fit :] - less.scores[self.num_fit :])
        cost = NATS_OF_SURPRISE * max(0, more.surprise - less.surprise)
        return difference.evidence > cost - math.log(level)


def grow(
    ground: Ground,
    found: Found,
    directions: Sequence[Direction],
    level: float,
    advance: Callable[[Found], object],
) -> Found:
    """Adds candidates one after another while the rows for selection are predicted better."""
    refused: set[str] = set()
    while len(found.entries) < MOST_EFFECTS:
        leads = _leads(ground, found, [d for d in directions if d.entry.name not in refused])
        tried = sorted(_simulated(ground, found, leads[:TRIED]), key=lambda pair: -pair[0])[:FITTED]
        fitted = []
        for _, entry, effect in tried:
            try:
                fitted.append(ground.sketched((*found.entries, entry), (*found.effects, effect)))
            except ValueError:
                continue
        better = [one for one in fitted if _is_usable(ground, one) and ground.adds(one, found, level)]
        refused |= {one.entries[-1].name for one in fitted if one not in better}
        if not better:
            if not tried or len(refused) > 3 * FITTED:
                return found
            continue
        found = _most_usual(better)
        found = ground.fitted(found.entries, found.effects, GROWN)
        refused = set()
        advance(found)
    return found


def _leads(ground: Ground, found: Found, directions: Sequence[Direction]) -> list[Lead]:
    """The best direction of each entry, in descending order of the estimated gain."""
    names = {entry.name for entry in found.entries}
    errors = ground.rough.errors(found.effects)
    beside = _changes(ground.rough, found, errors)
    gains = Gains.of(ground.rough, errors, beside)
    best: dict[str, Lead] = {}
    for lead in gains.leads([direction for direction in directions if direction.entry.name not in names]):
        best.setdefault(lead.entry.name, lead)
    return list(best.values())


def _changes(predictions: Predictions, found: Found, errors: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Changes of the errors by each value of the present effects."""
    if not found.entries:
        return []
    variables = variables_of(predictions, found.entries, found.effects)
    return list(slopes_of([predictions], found.effects, variables, [errors])[0].T)


def _simulated(ground: Ground, found: Found, leads: Sequence[Lead]) -> list[tuple[float, CatalogueEntry, Effect]]:
    """Score on the rows for fits, entry and effect of each lead, at the best of a few sizes."""
    results = []
    for lead in leads:
        best = None
        for share in dict.fromkeys((lead.share, 0.5 * lead.share, 1.0 if lead.share > 0.0 else -1.0)):
            effect = lead.direction.effect(share)
            if effect.is_neutral:
                continue
            try:
                score = ground.rough_score((*found.effects, effect))
            except ValueError:
                continue
            if best is None or score > best[0]:
                best = (score, lead.entry, effect)
        if best is not None:
            results.append(best)
    return results


def _is_usable(ground: Ground, found: Found) -> bool:
    entry, effect = found.entries[-1], found.effects[-1]
    return not (is_negligible(effect, entry.trials) or is_outside(effect, ground.simulation.model))


def _most_usual(sets: Sequence[Found]) -> Found:
    """The best set, or the most usual one of those that are not significantly worse."""
    best = max(sets, key=lambda one: one.scores.mean())
    alike = [one for one in sets if Difference(best.scores - one.scores).evidence < ALIKE]
    return min([best, *alike], key=lambda one: (one.surprise, -one.scores.mean()))


def prune(ground: Ground, found: Found, level: float) -> Found:
    """Drops effects without which the rows for selection are predicted as well."""
    index = len(found.entries) - 1
    while index >= 0:
        entries, effects = found.without(index)
        try:
            fewer = ground.sketched(entries, effects) if entries else ground.found((), ())
        except ValueError:
            index -= 1
            continue
        if not ground.adds(found, fewer, level):
            found = fewer
            index = min(index, len(found.entries))
        index -= 1
    return found


def replaced(
    ground: Ground, found: Found, directions: Sequence[Direction], advance: Callable[[], object]
) -> tuple[Found, list[list[Found]]]:
    """Replaces effects by better or more usual ones, and lists for each effect those that explain the data as well."""
    alike: list[list[Found]] = [[] for _ in found.entries]
    index, swaps = 0, 0
    while index < len(found.entries):
        advance()
        entries, effects = found.without(index)
        names = {entry.name for entry in found.entries}
        fewer = Found(entries, effects, found.scores)
        leads = _leads(ground, fewer, [one for one in directions if one.entry.name not in names])
        others = []
        for _, entry, effect in sorted(_simulated(ground, fewer, leads[:TRIED]), key=lambda one: -one[0])[:FITTED]:
            try:
                other = ground.sketched((*entries, entry), (*effects, effect))
            except ValueError:
                continue
            if _is_usable(ground, other) and Difference(found.scores - other.scores).evidence < ALIKE:
                others.append(other)
        better = [one for one in others if _is_preferred(one, found)]
        if better and swaps < SWAPS:
            best = _most_usual(better)
            found, swaps = ground.fitted(best.entries, best.effects, GROWN), swaps + 1
            alike = [[] for _ in found.entries]
            index = 0
            continue
        alike[index] = sorted(others, key=lambda one: -one.scores.mean())
        index += 1
    return found, alike


def _is_preferred(other: Found, found: Found) -> bool:
    """Whether a set explains the data better than another, or as well and by more usual effects."""
    evidence = Difference(other.scores - found.scores).evidence
    return evidence > ALIKE or (evidence > -ALIKE and other.surprise < found.surprise)


def separated(ground: Ground, found: Found, catalogue: Sequence[CatalogueEntry]) -> Found:
    """The set with an effect on each joint or motor where several of one kind overlap."""
    simulation, entries, effects = ground.simulation, list(found.entries), list(found.effects)
    for kind in {type(effect) for effect in effects}:
        own = [index for index, effect in enumerate(effects) if type(effect) is kind]
        acted_on = [elements(effects[index], simulation) for index in own]
        every = [one for some in acted_on for one in some]
        parts = {
            elements(entry.effect, simulation)[0]: entry
            for entry in catalogue
            if type(entry.effect) is kind and len(elements(entry.effect, simulation)) == 1
        }
        if len(own) < 2 or len(every) == len(set(every)) or not set(every) <= parts.keys():
            continue
        (name,) = entries[own[0]].fitted
        neutral = entries[own[0]].effect.parameters[name].neutral
        for one in sorted(set(every)):
            values = [effects[i].parameters[name].value for i, some in zip(own, acted_on, strict=True) if one in some]
            value = math.prod(values) if neutral == 1.0 else sum(values)
            if value != neutral:
                entries.append(parts[one])
                effects.append(parts[one].effect.with_parameters({name: value}))
        entries = [entry for index, entry in enumerate(entries) if index not in own]
        effects = [effect for index, effect in enumerate(effects) if index not in own]
    if len(entries) == len(found.entries):
        return found
    return ground.found(entries, effects)


def trace_effects(
    simulation: Simulation,
    measured: Measured,
    catalogue: Sequence[CatalogueEntry],
    *,
    rng: np.random.Generator,
    progress: LoopBar,
    known: Sequence[Effect] = (),
    found: Callable[[Trace], object] = lambda trace: None,
    settings: LoopSettings = DEFAULTS,
) -> Trace:
    """Traces the residual between data and a simulation to effects of a catalogue.

    Args:
        simulation: the simulator.
        measured: the data.
        catalogue: effects that the simulator may lack.
        rng: not used.
        progress: bar that shows how far the search is.
        known: effects from which the search begins, such as those of an unfinished run; those that are not in the
            catalogue are left out.
        found: called with the preliminary result whenever the search has come further.
        settings: the level.

    Returns:
        The effects found, the other effects tried, and equivalent alternatives; those found so far if the time of
        ``progress`` is up.

    Raises:
        OutOfTimeError: if the time is up before the search has begun.
    """
    progress.stage(EFFECTS)
    entries = [entry for entry in catalogue if not entry.effect.random]
    ground = Ground.of(simulation, measured)
    best, alike, directions, ended_in = _begun(ground, entries, known), [], [], None

    def keep(better: Found) -> None:
        nonlocal best
        best = better
        if better.entries:
            progress.has_result()
            progress.show_found(better.entries)
        found(_trace(ground, better, []))

    keep(best)
    try:
        for number in range(SWEEPS):
            directions = sweep(ground.rough, entries, lambda: progress.closer(0.5 / max(1, len(entries))))
            before, grown = best, prune(ground, grow(ground, best, directions, settings.level, keep), settings.level)
            keep(grown)
            if not grown.entries or (number and _names(grown) == _names(before)):
                break
            ground = Ground.of(simulation, measured, grown.effects)
            keep(ground.fitted(grown.entries, grown.effects, GROWN))
        if best.entries:
            progress.stage(OTHERS)
            other, alike = replaced(ground, best, directions, lambda: progress.closer(0.1))
            keep(separated(ground, prune(ground, other, settings.level) if other is not best else best, entries))
            alike = alike if _names(best) == _names(other) else []
    except OutOfTimeError as end:
        ended_in = str(end)
    progress.begin_last_fit(bool(best.entries))
    try:
        return replace(_trace(ground, best, alike, final=True), ended_in=ended_in)
    except OutOfTimeError as end:
        return replace(_trace(ground, best, alike), ended_in=ended_in or str(end))


def _begun(ground: Ground, catalogue: Sequence[CatalogueEntry], known: Sequence[Effect]) -> Found:
    """The known effects that are in the catalogue, if they predict better than none."""
    pairs = [(entry, effect) for effect in known if (entry := entry_of(effect, catalogue)) is not None]
    nothing = ground.found((), ())
    if not pairs:
        return nothing
    begun = ground.found(*zip(*pairs, strict=True))
    return begun if begun.scores.mean() > nothing.scores.mean() else nothing


def _names(found: Found) -> set[str]:
    return {entry.name for entry in found.entries}


def _trace(ground: Ground, found: Found, alike: Sequence[Sequence[Found]], *, final: bool = False) -> Trace:
    """The trace of a set; with ``final``, its values are fitted to all rows but the report's, with intervals."""
    fit = SetFit(found.effects, found.scores, tuple({} for _ in found.effects))
    if final and found.entries:
        parts = [ground.model.fit, ground.model.selection]
        fit = fit_set(parts, found.entries, found.effects, most_steps=GROWN, intervals=True)
    loss = -float(found.scores.mean())
    groups = tuple(
        tuple(
            Attempt(other.entries[-1], _fit_of(other), len(other.entries) - 1, -float(other.scores.mean()), 1.0)
            for other in others
        )
        for others in alike
    )
    exact = bool(np.median(np.abs(flat(ground.model.fit.errors(fit.effects)))) < EXACT)
    free = tuple(entry.fitted for entry in found.entries)
    return Trace(
        found.entries,
        Fit(fit.effects, free, loss, fit.half_widths),
        (),
        groups or ((),) * len(found.entries),
        exact,
        horizon=1,
        loss=math.nan if found.entries else loss,
    )


def _fit_of(found: Found) -> Fit:
    free = tuple(entry.fitted for entry in found.entries)
    return Fit(found.effects, free, -float(found.scores.mean()), tuple({} for _ in found.effects))
