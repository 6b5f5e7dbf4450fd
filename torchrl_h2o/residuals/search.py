"""Searches the set of effects with the best score: sweeps, linear algebra, refits of the best few sets."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchrl_h2o.effects import CatalogueEntry, Effect, is_negligible
from torchrl_h2o.effects.catalogue.plausibility import is_outside, surprise
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.progress import EFFECTS, OTHERS, LoopBar
from torchrl_h2o.residuals.refit import SetFit, fit_set, slopes_of, variables_of
from torchrl_h2o.residuals.score import Difference, Model, Predictions, fitted_scales, scores
from torchrl_h2o.residuals.settings import DEFAULTS
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.sweep import Direction, Gains, Lead, sweep

ROUGH_STEPS = 2560  # physics steps that are simulated for each candidate of a sweep and in first fits
ROUGH_ROWS = 1024  # rows beyond which these are not more
TRIED = 10  # candidates of the largest estimated gain whose gain is then simulated
FITTED = 4  # of these, the best whose values are fitted
SKETCH = 3  # steps of such a fit
GROWN = 5  # steps of the fit of a set after an effect was added
SWEEPS = 5  # largest number of sweeps
NATS_OF_SURPRISE = 2.0  # evidence that an effect needs for each degree of surprise
ALIKE = 3.0  # evidence, in nats, up to which two sets explain the data equally well
MOST_REFUSED = 12  # candidates that are refused one after another before none is added
SWAPS = 4  # largest number of effects that are replaced by others
MOST_EFFECTS = 40  # largest number of entries in a set


def surprise_of(effects: Sequence[Effect]) -> int:
    """How unusual effects are in all: the most unusual of each kind counts, because joints resemble each other."""
    most: dict[type, int] = {}
    for effect in effects:
        most[type(effect)] = max(surprise(effect), most.get(type(effect), 0))
    return sum(most.values())


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
        """How unusual the effects are in all; see :func:`surprise_of`."""
        return surprise_of(self.effects)

    def without(self, index: int) -> tuple[tuple[CatalogueEntry, ...], tuple[Effect, ...]]:
        """Entries and effects without one of them."""
        return (*self.entries[:index], *self.entries[index + 1 :]), (*self.effects[:index], *self.effects[index + 1 :])


@dataclass(frozen=True, eq=False)
class Ground:
    """The models on which sets are compared: predictions from start states filtered with the present effects.

    Args:
        simulation: the simulator without effects.
        model: predictions for fits and for selection; effects are added to ``simulation``.
        rough: predictions in some of the blocks for fits, without the shortest windows.
    """

    simulation: Simulation
    model: Model
    rough: Predictions

    @classmethod
    def of(cls, simulation: Simulation, measured: Measured, effects: Sequence[Effect] = ()) -> Ground:
        """Filters the start states with effects."""
        model = Model.of(simulation.with_effects(*effects), measured)
        counts = model.fit.effective_counts(model.fit.errors())
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

    def fitted(self, entries: Sequence[CatalogueEntry], effects: Sequence[Effect]) -> Found:
        """A set with its values fitted from the present ones."""
        return self.found(entries, fit_set([self.model.fit], entries, effects, most_steps=GROWN).effects)

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
    while len(found.entries) < MOST_EFFECTS and len(refused) <= MOST_REFUSED:
        fitted = _with_one_more(ground, found, directions, refused | _names(found))
        if not fitted:
            break
        better = [one for one in fitted if _is_usable(ground, one) and ground.adds(one, found, level)]
        if better:
            best = _most_usual(better)
            found, refused = ground.fitted(best.entries, best.effects), set()
            advance(found)
        else:
            refused |= {one.entries[-1].name for one in fitted}
    return found


def _with_one_more(
    ground: Ground, found: Found, directions: Sequence[Direction], passed_over: Collection[str]
) -> list[Found]:
    """The set with each of the few best candidates, whose values are fitted in a few steps."""
    leads = _leads(ground, found, [one for one in directions if one.entry.name not in passed_over])
    fitted = []
    for _, entry, effect in sorted(_simulated(ground, found, leads[:TRIED]), key=lambda one: -one[0])[:FITTED]:
        try:
            fitted.append(ground.sketched((*found.entries, entry), (*found.effects, effect)))
        except ValueError:  # the model rejects the effects together
            continue
    return fitted


def _leads(ground: Ground, found: Found, directions: Sequence[Direction]) -> list[Lead]:
    """The best direction of each entry, in descending order of the estimated gain."""
    errors, beside = ground.rough.errors(found.effects), []
    if found.entries:
        variables = variables_of(ground.rough, found.entries, found.effects)
        beside = list(slopes_of([ground.rough], found.effects, variables, [errors])[0].T)
    best: dict[str, Lead] = {}
    for lead in Gains.of(ground.rough, errors, beside).leads(directions):
        best.setdefault(lead.entry.name, lead)
    return list(best.values())


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
    """Drops effects without which the rows for selection are predicted as well, the last ones first."""
    for index in reversed(range(len(found.entries))):
        entries, effects = found.without(index)
        try:
            fewer = ground.sketched(entries, effects) if entries else ground.found((), ())
        except ValueError:  # the model rejects the others without this one
            continue
        if not ground.adds(found, fewer, level):
            found = fewer
    return found


def replaced(
    ground: Ground, found: Found, directions: Sequence[Direction], advance: Callable[[], object]
) -> tuple[Found, list[list[Found]]]:
    """Replaces effects by better or more usual ones, and lists for each effect those that explain the data as well."""
    alike: list[list[Found]] = []
    swaps = 0
    while len(alike) < len(found.entries):
        advance()
        fewer = Found(*found.without(len(alike)), found.scores)
        others = [
            other
            for other in _with_one_more(ground, fewer, directions, _names(found))
            if _is_usable(ground, other) and Difference(found.scores - other.scores).evidence < ALIKE
        ]
        better = [one for one in others if _is_preferred(one, found)]
        if better and swaps < SWAPS:
            best = _most_usual(better)
            found, alike, swaps = ground.fitted(best.entries, best.effects), [], swaps + 1
        else:
            alike.append(sorted(others, key=lambda one: -one.scores.mean()))
    return found, alike


def _is_preferred(other: Found, found: Found) -> bool:
    """Whether a set explains the data better than another, or as well and by more usual effects."""
    evidence = Difference(other.scores - found.scores).evidence
    return evidence > ALIKE or (evidence > -ALIKE and other.surprise < found.surprise)


@dataclass(frozen=True, eq=False)
class Explained:
    """Result of a search.

    Args:
        found: the set of effects.
        fit: its values, fitted to the rows for fits and for selection, with intervals.
        alike: for each effect, the sets that explain the data as well with another effect in its place, at their end.
    """

    found: Found
    fit: SetFit
    alike: Sequence[Sequence[Found]]


def search(
    simulation: Simulation,
    measured: Measured,
    catalogue: Sequence[CatalogueEntry],
    *,
    progress: LoopBar,
    so_far: Callable[[Found], object] = lambda found: None,
    level: float = DEFAULTS.level,
) -> Explained:
    """Searches the effects of a catalogue with which a simulator predicts the data best.

    Args:
        simulation: the simulator.
        measured: the data.
        catalogue: effects that the simulator may lack; random ones are left out, because noise is part of the score.
        progress: bar that shows how far the search is.
        so_far: called with each better set.
        level: significance level at which an effect is added.

    Raises:
        OutOfTimeError: if the time of ``progress`` is up; the last set that ``so_far`` received is the best until then.
    """
    entries = [entry for entry in catalogue if not entry.effect.random]
    ground = Ground.of(simulation, measured)
    found, directions = ground.found((), ()), []
    progress.stage(EFFECTS)
    for _ in range(SWEEPS):
        directions = sweep(ground.rough, entries, lambda: progress.closer(0.5 / max(1, len(entries))))
        before, found = found, prune(ground, grow(ground, found, directions, level, so_far), level)
        so_far(found)
        if _names(found) == _names(before):
            break
        ground = Ground.of(simulation, measured, found.effects)
        found = ground.fitted(found.entries, found.effects) if found.entries else ground.found((), ())
        so_far(found)
    progress.stage(OTHERS)
    found, alike = replaced(ground, found, directions, lambda: progress.closer(0.1))
    parts = [ground.model.fit, ground.model.selection]
    fit = fit_set(parts, found.entries, found.effects, most_steps=GROWN, intervals=True)
    return Explained(replace(found, effects=fit.effects), fit, alike)


def _names(found: Found) -> set[str]:
    return {entry.name for entry in found.entries}
