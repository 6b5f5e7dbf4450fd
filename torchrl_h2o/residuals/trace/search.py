"""Traces a residual to effects of a catalogue: forward selection, backward elimination, what cannot be told apart."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from tqdm import tqdm

from torchrl_h2o.effects import ActionEffect, CatalogueEntry, Effect, ObservationEffect
from torchrl_h2o.residuals.measured.chance import stand_in
from torchrl_h2o.residuals.measured.measured import Measured, thinned
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.trace.choose_horizon import choose_horizon
from torchrl_h2o.residuals.trace.fit import Fit, Free, fit
from torchrl_h2o.residuals.trace.problem import Problem, losses, matters
from torchrl_h2o.residuals.trace.screening import Lead, free_parameters, is_possible, promising_sets, screen
from torchrl_h2o.residuals.trace.significance import p_value_of_losses
from torchrl_h2o.residuals.trace.trace import Attempt, Trace

_LEVEL = 0.01  # of the whole search, divided by the number of entries
_PAYS = 0.002  # share of the held-out loss that an effect must take away to be worth a word
_PAYS_UNDER_NOISE = 0.02  # the same where sensors are noisy: start states that are a little wrong look like an effect
_WORTH_A_WORD = 0.003  # of what all effects explain together
_SCREENED = 400  # control steps, in windows of any length
_FEWEST = 100  # windows
_FITTED_STEPS = 1200  # in windows, while searching; what was found is fitted to all of them in the end
_FEWEST_FITTED = 200  # windows
_FITTED = 12  # rivals of an effect that are tried in its place: those that promised about as much as it did,
_PROMISING = 6  # and those that promised most
_FINALISTS = 3  # sets of leads of one size that are fitted on all windows
_AMONG = 60  # leads that sets are made of
_SETS = ((1, 12), (2, 4), (3, 4))  # how many entries may be added at once, and how many such sets are sketched
_MOST = 6  # effects
_ROUNDS = 3  # of growing and simplifying
_BEYOND_NOISE = 4.0  # times what an effect explains where there is nothing but noise
_WORTH_A_FIT = 0.5  # of what an effect explains: another one that misses more, the others as they are, is not fitted
_SAME = 1e-6  # of what an effect explains: less is a matter of rounding
_ALIKE = 0.1  # of what an effect explains: another one that misses more of it is no alternative


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
    horizon = choose_horizon(simulation, measured, catalogue, rng)
    return Search(Problem.pose(simulation, measured, horizon), catalogue, rng, progress).run()


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
    rivals: dict[str, list[Lead]] = field(default_factory=dict)

    def __post_init__(self):
        measured, horizon = self.problem.measured, self.problem.horizon
        self.first, self.nothing = self.problem, self.problem.held_out_loss(())
        self.all, self.judged = measured.fitted(horizon), measured.judged(horizon)
        self.fitted = thinned(self.all, max(_FEWEST_FITTED, _FITTED_STEPS // horizon))
        few = min(max(_FEWEST, _SCREENED // horizon), len(self.fitted))
        self.screened = np.sort(self.rng.choice(self.fitted, few, replace=False))

    def run(self) -> Trace:
        """Adds effects while they explain more than chance, takes out what is not needed, looks for their equals."""
        entries, best, groups = [], self._fitted([]), ()
        for _ in range(_ROUNDS):
            grown, best, exact = self._grown(entries, best)
            if grown == entries:
                break
            entries, best, groups = self._simplified(grown, best)
            if exact or entries == grown:
                break
            # an effect of many parameters may have stood in the way of what a simpler one leaves to be found
        self._weigh_by(best.effects)
        best = self._fitted(entries, best.effects, self.all)
        names = {entry.name for entry in entries}
        tried = sorted(self.attempts.values(), key=lambda attempt: attempt.loss)
        attempts = tuple(attempt for attempt in tried if attempt.entry.name not in names)
        return Trace(tuple(entries), best, attempts, groups, exact)

    def _grown(self, entries: list[CatalogueEntry], best: Fit) -> tuple[list[CatalogueEntry], Fit, bool]:
        """Adds effects while that pays; beside them whether nothing is left but that data are single precision."""
        entries, best, exact = self._weighed(entries, best)
        while not exact and len(entries) < _MOST:
            leads = screen(self.problem, best.effects, self._others(entries), self.screened, self.progress.update)
            added = self._best_addition(entries, best, leads)
            if added is None:
                break
            for entry in added[0][len(entries) :]:
                self.rivals[entry.name] = leads
            # which trial shows an entry's direction best is known by now
            known = {lead.entry.name: replace(lead.entry, trials=(dict(lead.trial),)) for lead in leads}
            self.catalogue = [known.get(entry.name, entry) for entry in self.catalogue]
            entries, best = self._in_best_order(*self._eliminated(*added))
            entries, best, exact = self._weighed(entries, best)
            self.progress.set_postfix_str(", ".join(entry.name for entry in entries))
        return entries, best, exact

    def _simplified(
        self, entries: list[CatalogueEntry], best: Fit
    ) -> tuple[list[CatalogueEntry], Fit, tuple[tuple[Attempt, ...], ...]]:
        """Each effect replaced by the simplest that does as well; beside them what else does as well."""
        groups = []
        for index in range(len(entries)):
            entries, best, group = self._simplest(entries, best, index)
            groups.append(group)
        return entries, best, tuple(groups)

    def _others(self, entries: Sequence[CatalogueEntry]) -> list[CatalogueEntry]:
        names = {entry.name for entry in entries}
        return [entry for entry in self.catalogue if entry.name not in names]

    def _weighed(self, entries: list[CatalogueEntry], best: Fit) -> tuple[list[CatalogueEntry], Fit, bool]:
        """Weighs residuals by the size that they have now; beside the fit whether nothing is left to explain.

        Where a better simulator gives other states to start from, what was fitted from the old ones is fitted anew.
        """
        states, posed = self.problem.states, self._weigh_by(best.effects)
        if entries and not np.array_equal(states, posed.states):
            entries, best = self._eliminated(entries, self._fitted(entries, best.effects))
            posed = self._weigh_by(best.effects)
        return entries, best, posed.within_rounding

    def _weigh_by(self, effects: Sequence[Effect]) -> Problem:
        """Weighs residuals by the size that they, and what sensor noise makes of them, have with some effects in."""
        posed = self._posed(effects)
        self.problem = replace(posed, simulation=self.problem.simulation)
        return posed

    def _posed(self, effects: Sequence[Effect]) -> Problem:
        mended = self.problem.simulation.with_effects(*effects)
        return Problem.pose(mended, self.problem.measured, self.problem.horizon)

    def _fitted(
        self, entries: Sequence[CatalogueEntry], start: Sequence[Effect] = (), starts: np.ndarray | None = None
    ) -> Fit:
        """All of the effects fitted together."""
        starts = self.fitted if starts is None else starts
        if not entries:
            return Fit((), (), float(losses(self.problem.residual((), starts)).mean()), ())
        return fit(self.problem, start, [free_parameters(entry) for entry in entries], starts)

    def _sketched(self, effects: Sequence[Effect], free: Sequence[Free], max_evaluations: int = 6) -> Fit:
        """Some of the effects fitted, the others as they are, on few windows."""
        return fit(self.problem, effects, free, self.screened, max_evaluations=max_evaluations)

    def _held_out(self, effects: Sequence[Effect]) -> np.ndarray:
        return losses(self.problem.residual(effects, self.judged))

    def _best_addition(
        self, entries: list[CatalogueEntry], best: Fit, leads: Sequence[Lead]
    ) -> tuple[list[CatalogueEntry], Fit] | None:
        """The entries that, fitted with those found, explain most of the held-out windows; None if none pay.

        Several are added at once where they explain clearly more than fewer do.
        """
        before = self._held_out(best.effects)
        least = _PAYS if self.problem.sensor_std is None else _PAYS_UNDER_NOISE
        winner, added, lowest = None, 0, before
        at_first = base = self.first.held_out_loss(best.effects)
        for size, sketched in enumerate(self._sketches(best, leads), start=1):
            if len(entries) + size > _MOST:
                break
            finalists = 0
            for chosen, start in sketched:
                together = [*entries, *(lead.entry for lead in chosen)]
                candidate = self._fitted(together, start.effects)
                # a share worth a word each of all that has been explained since the start
                loss = self.first.held_out_loss(candidate.effects)
                if not matters(self.nothing, at_first, loss, size * _WORTH_A_WORD):
                    continue  # what does not matter takes nobody's place
                after = self._held_out(candidate.effects)
                p = p_value_of_losses(lowest, after)
                pays = after.mean() < (1.0 - least) * lowest.mean() and p < _LEVEL / len(self.catalogue)
                if pays and matters(self.nothing, base, loss, (size - added) * _WORTH_A_WORD):
                    winner, added, lowest, base = (together, candidate), size, after, loss
                finalists += 1
                if finalists == _FINALISTS:
                    break
        if winner is None:
            return None
        explained = 1.0 - lowest.mean() / before.mean()
        return winner if explained > _BEYOND_NOISE * self._explained_by_noise(best, *winner, added) else None

    def _sketches(self, best: Fit, leads: Sequence[Lead]) -> Iterator[list[tuple[tuple[Lead, ...], Fit]]]:
        """The sets of one, two and three leads that promise most, fitted on few windows, the best first."""
        kept = [() for _ in best.effects]
        for size, tried in _SETS:
            among = [lead for lead in leads[:_AMONG] if lead.promise > 0.0]
            if len(among) < size:
                return
            sets = promising_sets(self.problem, best.effects, among, size, self.screened, tried)
            if size == 1:
                sets = [(lead,) for lead in leads[:tried]]
            sketches = [
                (
                    chosen,
                    self._sketched(
                        [*best.effects, *(lead.effect for lead in chosen)], [*kept, *(lead.free for lead in chosen)]
                    ),
                )
                for chosen in sets
                if self._possible(best, chosen)
            ]
            if size == 1:
                self._remember(best, sketches)
            yield sorted(sketches, key=lambda pair: pair[1].loss)

    def _remember(self, best: Fit, sketches: Sequence[tuple[tuple[Lead, ...], Fit]]) -> None:
        """Notes what entries explain by themselves beside those found, for the report."""
        before = self._held_out(best.effects)
        for (lead,), sketch in sketches:
            after = self._held_out(sketch.effects)
            p = p_value_of_losses(before, after)
            self.attempts[lead.entry.name] = Attempt(lead.entry, sketch, len(best.effects), float(after.mean()), p)

    def _possible(self, best: Fit, chosen: Sequence[Lead]) -> bool:
        return is_possible(self.problem, [*best.effects, *(lead.effect for lead in chosen)])

    def _explained_by_noise(self, best: Fit, entries: Sequence[CatalogueEntry], candidate: Fit, added: int) -> float:
        """The share of the loss that the last entries would explain if nothing but noise were there."""
        problem = self.problem
        if problem.sensor_std is None:
            return 0.0
        mended = problem.simulation.with_effects(*best.effects)
        data = stand_in(mended, problem.measured, problem.sensor_std, self.rng, problem.horizon, problem.states)
        posed = Problem.pose(mended, data, problem.horizon, sensor_std=problem.sensor_std)
        # from the values that the data gave, and that noise might give too
        free = [free_parameters(entry) for entry in entries[-added:]]
        refitted = fit(posed, candidate.effects[-added:], free, self.fitted)
        before = losses(posed.residual((), self.judged)).mean()
        return 1.0 - float(losses(posed.residual(refitted.effects, self.judged)).mean() / before)

    def _in_best_order(self, entries: list[CatalogueEntry], best: Fit) -> tuple[list[CatalogueEntry], Fit]:
        """The effects in the order in which actions, and observations, pass through them best: some do not commute."""
        lowest = self._held_out(best.effects)
        for kind in (ActionEffect, ObservationEffect):
            places = [index for index, entry in enumerate(entries) if isinstance(entry.effect, kind)]
            for one, other in combinations(places, 2):
                order = list(range(len(entries)))
                order[one], order[other] = other, one
                swapped = [entries[index] for index in order]
                candidate = self._fitted(swapped, [best.effects[index] for index in order])
                after = self._held_out(candidate.effects)
                if after.mean() < lowest.mean() and p_value_of_losses(lowest, after) < _LEVEL:
                    entries, best, lowest = swapped, candidate, after
        return entries, best

    def _eliminated(self, entries: list[CatalogueEntry], best: Fit) -> tuple[list[CatalogueEntry], Fit]:
        """Takes out, one by one, what the others make up for."""
        removed = True
        while removed and len(entries) > 1:
            removed = False
            before = self._held_out(best.effects)
            for index in range(len(entries)):
                rest = [entry for i, entry in enumerate(entries) if i != index]
                kept = [effect for i, effect in enumerate(best.effects) if i != index]
                candidate = self._fitted(rest, kept)
                after = self._held_out(candidate.effects)
                needed = after.mean() > before.mean() / (1.0 - _PAYS) and p_value_of_losses(after, before) < _LEVEL
                if not needed:
                    entries, best, removed = rest, candidate, True
                    break
        return entries, best

    def _simplest(
        self, entries: list[CatalogueEntry], best: Fit, index: int
    ) -> tuple[list[CatalogueEntry], Fit, tuple[Attempt, ...]]:
        """Puts in an effect's place, of those that do as well, one with the fewest parameters; the rest beside it."""
        seen = set()
        while True:
            seen.add(entries[index].name)
            as_good = self._as_good(entries, best, index)
            better = [a for a in as_good if self._p_value(self.problem, best, a.fit) < _LEVEL]
            if not better or better[0].entry.name in seen:
                break
            # chosen while less was known, as good then, and no longer
            entries, best = self._instead(entries, index, better[0].entry), better[0].fit
        own = Attempt(entries[index], best, index, float(self._held_out(best.effects).mean()), 1.0)
        group = [own, *as_good]
        order = {entry.name: place for place, entry in enumerate(self.catalogue)}
        simplest = min(group, key=lambda a: (len(free_parameters(a.entry)), order[a.entry.name]))
        rest = tuple(attempt for attempt in group if attempt is not simplest)
        return self._instead(entries, index, simplest.entry), simplest.fit, rest

    def _instead(self, entries: list[CatalogueEntry], index: int, other: CatalogueEntry) -> list[CatalogueEntry]:
        """The entries with another in one's place, whose rivals are then its own."""
        self.rivals[other.name] = self.rivals[entries[index].name]
        return [other if i == index else entry for i, entry in enumerate(entries)]

    def _rivals(self, entries: Sequence[CatalogueEntry], index: int) -> list[Lead]:
        """The entries that promised most, or about as much as one of those found did, when it was added."""
        leads = self.rivals[entries[index].name]
        names = {entry.name for entry in entries}
        promise = next(lead.promise for lead in leads if lead.entry.name == entries[index].name)
        others = [lead for lead in leads if lead.entry.name not in names]
        nearest = sorted(others, key=lambda lead: abs(lead.promise - promise))[:_FITTED]
        return list({lead.entry.name: lead for lead in (*nearest, *others[:_PROMISING])}.values())

    def _as_good(self, entries: Sequence[CatalogueEntry], best: Fit, index: int) -> tuple[Attempt, ...]:
        """Which other entries do as well as one of those found, in its place.

        More parameters have to earn their place: what has fewer, and seems worse by the size that residuals have
        without the effect, is as good where it is no worse by the size that they have with it and misses nothing worth
        a word.
        """
        kept = [effect for i, effect in enumerate(best.effects) if i != index]
        self._weigh_by(kept)
        with_it = self._held_out(best.effects)
        explained = self._held_out(kept).mean() - with_it.mean()
        if explained <= 0.0:
            return ()  # what explains nothing has no equals
        few_with_it, few_without = (
            losses(self.problem.residual(e, self.screened)).mean() for e in (best.effects, kept)
        )
        as_good = []
        for lead in self._rivals(entries, index):
            instead = [lead.entry if i == index else entry for i, entry in enumerate(entries)]
            effects = [*kept[:index], lead.effect, *kept[index:]]
            if not is_possible(self.problem, effects):
                continue
            free = [free_parameters(entry) for entry in instead]
            start = self._sketched(effects, free, max_evaluations=20)  # the others may have far to go
            if few_without - start.loss < _WORTH_A_FIT * (few_without - few_with_it):
                continue
            candidate = self._fitted(instead, start.effects)
            after = self._held_out(candidate.effects)
            p = p_value_of_losses(after, with_it)
            if p <= _LEVEL and len(lead.free) < len(free_parameters(entries[index])):
                p = max(p, self._p_value_by_what_is_left(candidate, best))
            worse = (after.mean() - with_it.mean()) / explained
            if worse < _SAME or (worse < _ALIKE and p > _LEVEL):
                as_good.append(Attempt(lead.entry, candidate, index, float(after.mean()), p))
        return tuple(sorted(as_good, key=lambda attempt: attempt.loss))

    def _p_value_by_what_is_left(self, worse: Fit, better: Fit) -> float:
        """Of a difference as large, by the size that residuals have with the better; 0 if it is worth a word."""
        at_first = (self.first.held_out_loss(fitted.effects) for fitted in (worse, better))
        if matters(self.nothing, *at_first, _WORTH_A_WORD):
            return 0.0
        left = replace(self._posed(better.effects), simulation=self.problem.simulation)
        return self._p_value(left, worse, better)

    def _p_value(self, problem: Problem, worse: Fit, better: Fit) -> float:
        """Of a difference as large between two fits on held-out windows, as a problem weighs them."""
        before, after = (losses(problem.residual(fitted.effects, self.judged)) for fitted in (worse, better))
        return p_value_of_losses(before, after)
