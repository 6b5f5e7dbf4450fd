"""Traces a residual to effects of a catalogue: forward selection, backward elimination, and what cannot be told apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from tqdm import tqdm

from torchrl_h2o.effects import CatalogueEntry, Effect
from torchrl_h2o.residuals.fit import Fit, Problem, fit, losses
from torchrl_h2o.residuals.measured import Measured
from torchrl_h2o.residuals.screening import Lead, free_parameters, screen
from torchrl_h2o.residuals.significance import p_value
from torchrl_h2o.residuals.simulation import Simulation

_LEVEL = 0.01  # of the whole search, divided by the number of entries
_PAYS = 0.01  # share of the held-out loss that an effect must take away to be worth a word
_SCREENED = 1000  # windows
_FITTED = 12  # leads that are fitted on the screened windows
_FINALISTS = 4  # leads that are fitted on all windows
_MOST = 6  # effects
_SAME = 1e-6  # of what an effect explains: less is a matter of rounding
_ALIKE = 0.1  # of what an effect explains: another one that misses more of it is no alternative


@dataclass(frozen=True, eq=False)
class Attempt:
    """An effect that was tried beside the others, and what came of it.

    Args:
        entry: of the catalogue.
        effect: at its best fit.
        loss: on held-out windows, with those found before it.
        p_value: of its gain.
    """

    entry: CatalogueEntry
    effect: Effect
    loss: float
    p_value: float


@dataclass(frozen=True, eq=False)
class Trace:
    """What a search found.

    Args:
        entries: of the effects found, in the order in which they pay.
        fit: their joint fit.
        losses: (W), of held-out windows, with all of them.
        loss_before: mean loss of the held-out windows without any.
        attempts: what else was tried, the best first.
        groups: for each effect found, others that do as well in its place, the best first.
        problem: with the scales of the last round.
    """

    entries: tuple[CatalogueEntry, ...]
    fit: Fit
    attempts: tuple[Attempt, ...]
    groups: tuple[tuple[Attempt, ...], ...]
    problem: Problem


def trace_effects(
    simulation: Simulation,
    measured: Measured,
    catalogue: Sequence[CatalogueEntry],
    *,
    rng: np.random.Generator,
    progress: tqdm,
) -> Trace:
    """Traces the residual between data and a simulation to effects of a catalogue.

    Args:
        simulation: the simulator.
        measured: the data.
        catalogue: the effects that it could lack.
        rng: draws the windows that are screened.
        progress: shows how far the search is.

    Returns:
        What was found, what was tried, and what cannot be told apart.
    """
    return Search(Problem.pose(simulation, measured), catalogue, rng, progress).run()


@dataclass
class Search:
    """A search over a catalogue.

    Args:
        problem: what to explain.
        catalogue: the entries.
        rng: draws the windows that are screened.
        progress: shows how far it is.
    """

    problem: Problem
    catalogue: Sequence[CatalogueEntry]
    rng: np.random.Generator
    progress: tqdm
    attempts: dict[str, Attempt] = field(default_factory=dict)

    def __post_init__(self):
        measured, horizon = self.problem.measured, self.problem.horizon
        self.fitted = measured.windows(horizon, horizon, held_out=False)
        self.judged = measured.windows(horizon, horizon, held_out=True)
        few = min(_SCREENED, len(self.fitted))
        self.screened = np.sort(self.rng.choice(self.fitted, few, replace=False))

    def run(self) -> Trace:
        """Adds the effect that explains most while one explains more than chance, and takes out what is not needed."""
        entries, best = [], self._fitted([])
        leads = []
        while self._weigh(best) and len(entries) < _MOST:
            leads = screen(self.problem, best.effects, self._others(entries), self.screened, self.progress.update)
            added = self._best_addition(entries, best, leads)
            if added is None:
                break
            entries, best = self._eliminated(*added)
            self.progress.set_postfix_str(", ".join(entry.name for entry in entries))
        groups = tuple(self._as_good(entries, best, index) for index in range(len(entries)))
        tried = sorted(self.attempts.values(), key=lambda attempt: attempt.loss)
        found = {entry.name for entry in entries}
        attempts = tuple(attempt for attempt in tried if attempt.entry.name not in found)
        return Trace(tuple(entries), best, attempts, groups, self.problem)

    def _others(self, entries: Sequence[CatalogueEntry]) -> list[CatalogueEntry]:
        names = {entry.name for entry in entries}
        return [entry for entry in self.catalogue if entry.name not in names]

    def _weigh(self, best: Fit) -> bool:
        """Weighs residuals by the size that they have now; returns whether anything is left to explain."""
        return not self._weigh_by(best.effects).within_rounding

    def _weigh_by(self, effects: Sequence[Effect]) -> Problem:
        simulation = self.problem.simulation.with_effects(*effects)
        posed = Problem.pose(simulation, self.problem.measured, self.problem.horizon)
        self.problem = replace(self.problem, scale=posed.scale)
        return posed

    def _fitted(self, entries: Sequence[CatalogueEntry], start: Sequence[Effect] = (), few: bool = False) -> Fit:
        starts = self.screened if few else self.fitted
        if not entries:
            return Fit((), (), float(losses(self.problem.residual((), starts)).mean()), ())
        return fit(self.problem, start, [free_parameters(e) for e in entries], starts, max_evaluations=8 if few else 25)

    def _held_out(self, effects: Sequence[Effect]) -> np.ndarray:
        return losses(self.problem.residual(effects, self.judged))

    def _best_addition(
        self, entries: list[CatalogueEntry], best: Fit, leads: Sequence[Lead]
    ) -> tuple[list[CatalogueEntry], Fit] | None:
        """The entry that, fitted with those found, explains most of the held-out windows; None if none pays."""
        few = [
            (lead, self._fitted([*entries, lead.entry], [*best.effects, lead.effect], few=True))
            for lead in leads[:_FITTED]
        ]
        few.sort(key=lambda pair: pair[1].loss)
        before = self._held_out(best.effects)
        winner, lowest = None, before.mean()
        for lead, start in few[:_FINALISTS]:
            candidate = self._fitted([*entries, lead.entry], start.effects)
            after = self._held_out(candidate.effects)
            p = p_value(before - after)
            self.attempts[lead.entry.name] = Attempt(lead.entry, candidate.effects[-1], float(after.mean()), p)
            pays = after.mean() < (1.0 - _PAYS) * before.mean()
            if pays and p < _LEVEL / len(self.catalogue) and after.mean() < lowest:
                winner, lowest = ([*entries, lead.entry], candidate), after.mean()
        return winner

    def _eliminated(self, entries: list[CatalogueEntry], best: Fit) -> tuple[list[CatalogueEntry], Fit]:
        """Takes out, one by one, what the others make up for."""
        removed = True
        while removed and len(entries) > 1:
            removed = False
            before = self._held_out(best.effects)
            for index in range(len(entries) - 1):  # not the one that was just added
                rest = [entry for i, entry in enumerate(entries) if i != index]
                kept = [effect for i, effect in enumerate(best.effects) if i != index]
                candidate = self._fitted(rest, kept)
                after = self._held_out(candidate.effects)
                needed = after.mean() > before.mean() / (1.0 - _PAYS) and p_value(after - before) < _LEVEL
                if not needed:
                    entries, best, removed = rest, candidate, True
                    break
        return entries, best

    def _as_good(self, entries: Sequence[CatalogueEntry], best: Fit, index: int) -> tuple[Attempt, ...]:
        """Which other entries do as well as one of those found, in its place."""
        rest = [entry for i, entry in enumerate(entries) if i != index]
        kept = [effect for i, effect in enumerate(best.effects) if i != index]
        self._weigh_by(kept)
        with_it, without = self._held_out(best.effects), self._held_out(kept).mean()
        few_with_it, few_without = (
            losses(self.problem.residual(e, self.screened)).mean() for e in (best.effects, kept)
        )
        leads = screen(self.problem, kept, self._others(entries), self.screened, self.progress.update)
        as_good = []
        for lead in leads[:_FITTED]:
            start = self._fitted([*rest, lead.entry], [*kept, lead.effect], few=True)
            if few_without - start.loss < 0.7 * (few_without - few_with_it):
                continue
            candidate = self._fitted([*rest, lead.entry], start.effects)
            after = self._held_out(candidate.effects)
            p = p_value(after - with_it)
            worse = (after.mean() - with_it.mean()) / (without - with_it.mean())
            if worse < _SAME or (worse < _ALIKE and p > _LEVEL):
                as_good.append(Attempt(lead.entry, candidate.effects[-1], float(after.mean()), p))
        return tuple(sorted(as_good, key=lambda attempt: attempt.loss))
