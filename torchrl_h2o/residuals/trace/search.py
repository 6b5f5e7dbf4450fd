"""Traces a residual to effects of a catalogue: grow, simplify, repeat, then fit the effects found to all windows."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from torchrl_h2o.effects import CatalogueEntry, Effect
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.progress import EFFECTS, OTHERS, LoopBar, OutOfTimeError
from torchrl_h2o.residuals.settings import DEFAULTS, LoopSettings
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.trace.begin import (
    begin_anew,
    begin_in_longer_windows,
    begin_noise_free,
    begin_with,
    begin_with_forces,
    in_longer_windows,
    replaced_by_forces,
)
from torchrl_h2o.residuals.trace.choose_horizon import choose_horizon, fitted_in_longer_windows
from torchrl_h2o.residuals.trace.eliminate import eliminate
from torchrl_h2o.residuals.trace.families import entries_of_elements
from torchrl_h2o.residuals.trace.grow import grow, is_beaten_by
from torchrl_h2o.residuals.trace.outcome import Trace
from torchrl_h2o.residuals.trace.per_joint import divide_by_element
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.rival_sets import with_most_usual_set
from torchrl_h2o.residuals.trace.simplify import simplify, spare
from torchrl_h2o.residuals.trace.state import SearchState

SET_FITTED = 0.04  # share by which the fit of another set of effects brings the bar closer to the end of its stage
ENTRY_TRIED = 0.015  # share by which an entry tried in an effect's place brings the bar closer to the end of its stage


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
        rng: generator for screened windows and synthetic noise.
        progress: bar that shows how far the search is.
        known: effects from which the search begins, such as those of an unfinished run; those that are not in the
            catalogue are left out. The search begins anew without them if they predict the motion no better than the
            guess that every velocity stays as it is.
        found: called with the preliminary result at the beginning and whenever the search has come further.
        settings: thresholds and budgets.

    Returns:
        The effects found, the other effects tried, and equivalent alternatives; those found so far if the time of
        ``progress`` is up.

    Raises:
        OutOfTimeError: if the time is up before the search has begun.
    """
    progress.stage(EFFECTS)
    horizon = choose_horizon(simulation, measured, rng, settings)
    problem = Problem.pose(simulation, measured, horizon)

    def keep(state: SearchState) -> None:
        nonlocal best
        best = state
        if state.entries:
            progress.has_result()
        found(_outcome(state))

    best = begin_with(SearchState.begin(problem, catalogue, rng, settings), known)
    keep(best)
    others, ended_in = (), None
    try:
        best, others = with_most_usual_set(
            _searched(best, catalogue, rng, progress, keep), lambda: progress.closer(SET_FITTED)
        )
    except OutOfTimeError as end:
        ended_in = str(end)
    progress.begin_last_fit(bool(best.entries))
    try:
        if ended_in is None:
            best = _divided_in_longer_windows(best, catalogue, rng)
        best = _fitted_to_all(best)
        other = None if ended_in else replaced_by_forces(best, catalogue, rng, progress)
    except OutOfTimeError as end:  # the values stay those of the search's windows
        other, ended_in = None, ended_in or str(end)
    if other is not None:
        return replace(_outcome(other), by_forces=True)
    return replace(_outcome(best), others=others, ended_in=ended_in)


def _searched(
    state: SearchState,
    catalogue: Sequence[CatalogueEntry],
    rng: np.random.Generator,
    progress: LoopBar,
    found: Callable[[SearchState], object],
) -> SearchState:
    """What rounds of growing and simplifying find; ``found`` is called with each better state."""
    for attempt in range(state.settings.rounds):
        state = grow(state, rng, progress, found)
        if attempt == 0:
            state = _from_another_beginning(state, catalogue, rng, progress, found)
        if not state.entries:
            break
        found(state)
        progress.stage(OTHERS)
        grown, simpler = state, simplify(state, lambda: progress.closer(ENTRY_TRIED))
        state = spare(eliminate(simpler))
        progress.show_found(state.entries)
        found(state)
        if state is not simpler or (state.exact and not grown.exact):
            continue  # an effect was replaced by one that is not needed, or after which only rounding is left
        if state.exact:
            break
        state = divide_by_element(_rescaled(state), rng)
        progress.show_found(state.entries)
        # a further round helps where effects have been replaced, by simpler ones or by one for each joint, because the
        # alternatives of an effect depend on the other effects
        if state.entries == grown.entries:
            break
        found(state)
    if state.entries and not state.groups:  # the last round has changed the effects, whose alternatives are now others
        state = simplify(state, lambda: progress.closer(ENTRY_TRIED))
    return state


def _from_another_beginning(
    state: SearchState,
    catalogue: Sequence[CatalogueEntry],
    rng: np.random.Generator,
    progress: LoopBar,
    found: Callable[[SearchState], object],
) -> SearchState:
    """What a search finds that begins otherwise, if the first one has left something that this may explain."""
    silent = begin_noise_free(state, catalogue, rng, progress)
    if silent is not None and (grown := grow(silent, rng, progress)).exact:
        found(grown)
        return grown
    progress.show_found(state.entries)
    for begin in (begin_anew, begin_with_forces):
        if (other := begin(state, catalogue, rng, progress)) is not None:
            progress.show_found(other.entries)
            found(other)
            return grow(other, rng, progress, found)
    return _from_longer_windows(state, catalogue, rng, progress, found)


def _from_longer_windows(
    state: SearchState,
    catalogue: Sequence[CatalogueEntry],
    rng: np.random.Generator,
    progress: LoopBar,
    found: Callable[[SearchState], object],
) -> SearchState:
    """What a search in longer windows finds, if it finds other effects than the first one; else the first one's.

    If the time ends before, a list that is significantly better than the first one's has been handed to ``found``.
    """
    longer = begin_in_longer_windows(state, catalogue, rng, progress)
    if longer is None:
        return state

    def so_far(grown: SearchState) -> None:
        if is_beaten_by(longer, grown):
            found(replace(grown, chosen_horizon=state.problem.horizon))

    grown = replace(grow(longer, rng, progress, so_far), chosen_horizon=state.problem.horizon)
    same = {entry.name for entry in grown.entries} == {entry.name for entry in state.entries}
    if same or is_beaten_by(grown, longer):
        progress.show_found(state.entries)
        return state
    found(grown)
    return grown


def _divided_in_longer_windows(
    state: SearchState, catalogue: Sequence[CatalogueEntry], rng: np.random.Generator
) -> SearchState:
    """Divides effects on several joints or motors where longer windows show that these differ.

    In windows of one step, the noise of the start states hides such a difference. Joints that then need no effect lose
    theirs. Effects that are divided here have no list of alternatives.
    """
    simulation = state.problem.simulation
    if not any(entries_of_elements(entry, state.catalogue, simulation) for entry in state.entries):
        return state  # spares the fit in longer windows
    if (longer := in_longer_windows(state, catalogue, rng)) is None:
        return state
    divided = divide_by_element(_rescaled(longer), rng)
    if divided.entries == longer.entries:
        return state
    divided = eliminate(divided)
    alternatives = dict(zip((entry.name for entry in state.entries), state.groups, strict=False))
    groups = tuple(alternatives.get(entry.name, ()) for entry in divided.entries)
    return replace(state, entries=divided.entries, fit=divided.fit, groups=groups)


def _rescaled(state: SearchState) -> SearchState:
    return state.rescaled(state.posed_at(state.fit.effects))


def _fitted_to_all(state: SearchState) -> SearchState:
    """The effects found, fitted to all windows with residuals scaled by their present size, then in longer windows.

    Alternatives and other sets keep the values of the search's windows.
    """
    rescaled = _rescaled(state)
    fitted = rescaled.refitted(state.entries, state.fit.effects, state.windows.all)
    if state.entries:
        fitted = fitted_in_longer_windows(rescaled.problem, fitted, state.settings)
    return rescaled.with_found(state.entries, fitted)


def _outcome(state: SearchState) -> Trace:
    names = {entry.name for entry in state.entries}
    tried = sorted(state.attempts.values(), key=lambda attempt: attempt.loss)
    attempts = tuple(attempt for attempt in tried if attempt.entry.name not in names)
    groups = state.groups or ((),) * len(state.entries)  # alternatives are looked for after the effects
    loss = math.nan if state.entries else state.first_loss
    horizon = state.chosen_horizon or state.problem.horizon
    return Trace(state.entries, state.fit, attempts, groups, state.exact, horizon=horizon, loss=loss)
