"""State of the search for effects, and the fits and losses that its steps share.

A step of the search takes a :class:`SearchState` and returns a new one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from torchrl_h2o.effects import CatalogueEntry, Effect
from torchrl_h2o.residuals.measured.sensor_noise import sensor_noise
from torchrl_h2o.residuals.measured.transitions import thinned
from torchrl_h2o.residuals.settings import DEFAULTS, LoopSettings
from torchrl_h2o.residuals.trace.fit import DIFFERENCE_STEP, Fit, Free, fit
from torchrl_h2o.residuals.trace.outcome import Attempt, Question
from torchrl_h2o.residuals.trace.problem import Problem, losses
from torchrl_h2o.residuals.trace.screening import Lead, free_parameters
from torchrl_h2o.residuals.trace.significance import p_value_of_losses

MIN_SHARE = 0.003  # share of the whole reduction of the loss that each added effect must contribute
# the same share if some coordinates are unobserved: an effect may also make up for errors of their estimates
MIN_SHARE_UNOBSERVED = 0.005
# share of the present loss below which an addition counts, however small its part of the whole reduction is
MUCH_LOWER = 0.5
MIN_SCREENED = 60  # smallest number of windows on which entries are screened
MIN_FITTED = 120  # smallest number of windows in a fit during the search
SKETCH_EVALUATIONS = 6  # evaluations of the residual in a sketch (quick fit) of an addition
RIVAL_MIN_SKETCH = 0.5  # share of an effect's gain that an alternative must reach in its sketch to be fitted
RIVAL_MIN_EXACT = 0.9  # value in the place of ``rival_min_sketch`` if the effects found explain the data up to rounding


@dataclass(frozen=True, eq=False)
class SearchWindows:
    """First rows of the windows that a search uses.

    Args:
        all: windows for the final fit.
        fitted: part of them, for fits during the search.
        screened: part of ``fitted``, for screening and sketches.
    """

    all: np.ndarray
    fitted: np.ndarray
    screened: np.ndarray

    @classmethod
    def draw(cls, problem: Problem, rng: np.random.Generator, settings: LoopSettings) -> SearchWindows:
        """Chooses the windows of a problem; the screened ones are drawn at random."""
        horizon = problem.horizon
        every = problem.measured.fitted(horizon)
        block = problem.measured.block
        fitted = thinned(every, max(MIN_FITTED, settings.fitted_steps // horizon), block)
        few = min(max(MIN_SCREENED, settings.screened_steps // horizon), len(fitted))
        blocks = [fitted[first : first + block] for first in range(0, len(fitted), block)]
        chosen = rng.choice(len(blocks), min(-(-few // block), len(blocks)), replace=False)
        return cls(every, fitted, np.concatenate([blocks[index] for index in np.sort(chosen)]))


@dataclass(frozen=True, eq=False)
class SearchState:
    """Effects that a search has found so far, and the data for its next steps.

    Args:
        entries: entries of the effects found, in the order of their composition.
        fit: joint fit of these effects.
        problem: residuals, scaled by their size with these effects put in.
        catalogue: all entries, each with the trials that later screenings use.
        first: the problem before the first effect was found.
        first_loss: mean loss of ``first`` on the selection windows without any effects.
        windows: the windows of the search.
        settings: thresholds and budgets.
        attempts: entries that were sketched in addition to the effects found, by name.
        rivals: all leads of the screening after which an entry was added, by the entry's name.
        groups: for each effect found, alternatives with an equivalent loss.
        alternatives: the alternatives that were found so far, by :class:`Question`.
        exact: True if the residual is within the rounding of single-precision data.
        noise_free: whether the search takes the sensors for free of noise, whatever the residual looks like.
        chosen_horizon: control steps per window that were chosen for the data, by which forces are looked for; None for
            those of the problem. A search in longer windows has others.
    """

    entries: tuple[CatalogueEntry, ...]
    fit: Fit
    problem: Problem
    catalogue: tuple[CatalogueEntry, ...]
    first: Problem
    first_loss: float
    windows: SearchWindows
    settings: LoopSettings
    attempts: Mapping[str, Attempt] = field(default_factory=dict)
    rivals: Mapping[str, Sequence[Lead]] = field(default_factory=dict)
    groups: tuple[tuple[Attempt, ...], ...] = ()
    alternatives: Mapping[Question, tuple[Attempt, ...]] = field(default_factory=dict)
    exact: bool = False
    noise_free: bool = False
    chosen_horizon: int | None = None

    @classmethod
    def begin(
        cls,
        problem: Problem,
        catalogue: Sequence[CatalogueEntry],
        rng: np.random.Generator,
        settings: LoopSettings = DEFAULTS,
    ) -> SearchState:
        """State of a search that has found nothing yet."""
        windows = SearchWindows.draw(problem, rng, settings)
        nothing = _no_effects(problem, windows.fitted)
        return cls((), nothing, problem, tuple(catalogue), problem, problem.selection_loss(()), windows, settings)

    @property
    def others(self) -> tuple[CatalogueEntry, ...]:
        """Entries of the catalogue that are not among the effects found."""
        names = {entry.name for entry in self.entries}
        return tuple(entry for entry in self.catalogue if entry.name not in names)

    @property
    def min_share(self) -> float:
        """Share of the whole reduction of the loss that each added effect must contribute."""
        hidden = self.problem.simulation.state_map.hidden
        return MIN_SHARE_UNOBSERVED if hidden else MIN_SHARE

    @property
    def rival_min_sketch(self) -> float:
        """Share of a gain that another explanation must reach in a quick fit to be fitted."""
        return RIVAL_MIN_EXACT if self.exact else RIVAL_MIN_SKETCH

    def with_found(self, entries: Sequence[CatalogueEntry], fitted: Fit) -> SearchState:
        """The state with other effects found; without groups, unless the entries are the same."""
        entries = tuple(entries)
        return replace(self, entries=entries, fit=fitted, groups=self.groups if entries == self.entries else ())

    def refitted(
        self,
        entries: Sequence[CatalogueEntry],
        start: Sequence[Effect],
        rows: np.ndarray | None = None,
        *,
        difference_step: float = DIFFERENCE_STEP,
    ) -> Fit:
        """Joint fit of entries from given values, on the windows of the search or on others.

        Args:
            entries: the entries to fit.
            start: their effects, with the values from which the fit starts.
            rows: first rows of the windows; by default those of the search.
            difference_step: relative step of the finite differences.
        """
        rows = self.windows.fitted if rows is None else rows
        if not entries:
            return _no_effects(self.problem, rows)
        free = [free_parameters(entry) for entry in entries]
        budget = self.settings.max_evaluations
        return fit(self.problem, start, free, rows, max_evaluations=budget, difference_step=difference_step)

    def sketched(self, effects: Sequence[Effect], free: Sequence[Free], max_evaluations: int) -> Fit:
        """Quick fit of some parameters on the screened windows."""
        return fit(
            self.problem,
            effects,
            free,
            self.windows.screened,
            max_evaluations=max_evaluations,
        )

    def screened_loss(self, effects: Sequence[Effect]) -> float:
        """Mean loss of the screened windows with effects put in, comparable with that of a sketch."""
        screened = self.windows.screened
        return float(losses(self.problem.residual(effects, screened)).mean())

    def selection_losses(self, effects: Sequence[Effect]) -> np.ndarray:
        """Robust loss of each selection window, (W), with effects put in."""
        return self.problem.selection_losses(effects)

    def p_value(self, before: np.ndarray, after: np.ndarray) -> float:
        """p-value of a decrease of losses on the selection windows, (W) each."""
        return p_value_of_losses(before, after, self.settings)

    def posed_at(self, effects: Sequence[Effect], *, sensor_std: np.ndarray | None = None) -> Problem:
        """The problem of the simulation with effects put in: start states and scales of the residuals anew.

        Args:
            effects: the effects to put in.
            sensor_std: (n), standard deviation of the readings' noise; by default zeros if the search takes the sensors
                for free of noise, and otherwise estimated from the data.
        """
        if not effects and sensor_std is None:
            return self.first
        base = self.problem
        if sensor_std is None and self.noise_free:
            sensor_std = base.measured.no_noise
        mended = base.simulation.with_effects(*effects)
        return Problem.pose(mended, base.measured, base.horizon, sensor_std=sensor_std)

    def posed_instead(self, effects: Sequence[Effect]) -> Problem:
        """The problem with other effects in the place of those found, and without noise if these leave none.

        An estimate of the noise with the wrong effects contains their error, and fits of these effects are then biased.

        Args:
            effects: the effects to put in.
        """
        if not self._leaves_no_noise:
            return self.posed_at(effects)
        return self.posed_at(effects, sensor_std=self.problem.measured.no_noise)

    @cached_property
    def _leaves_no_noise(self) -> bool:
        """Whether the sensors have no noise by the residual that the effects found leave."""
        mended = self.problem.simulation.with_effects(*self.fit.effects)
        return self.noise_free or sensor_noise(mended, self.problem.measured) is None

    def rescaled(self, posed: Problem) -> SearchState:
        """The state with the start states and scales of a problem posed with effects put in."""
        return replace(self, problem=replace(posed, simulation=self.problem.simulation))


def _no_effects(problem: Problem, rows: np.ndarray) -> Fit:
    return Fit((), (), float(losses(problem.residual((), rows)).mean()), ())
