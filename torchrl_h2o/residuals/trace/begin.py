"""Begins a search with known effects, or another search after the first one.

Another search has windows and effects of its own if the first one explains no motion, or less than the effects that a
regression of the missing forces proposes; it has no sensor noise if one more effect explains most of what was taken for
noise; or it has longer windows where sensors are noisy.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from torchrl_h2o.effects import CatalogueEntry, Effect
from torchrl_h2o.effects.catalogue.entry import entry_of
from torchrl_h2o.residuals.measured.constant_velocity import (
    BETTER_THAN_GUESS,
    effects_on_unpredicted_joints,
    errors_ahead,
    explains_motion,
)
from torchrl_h2o.residuals.measured.missing_force import LESS_FORCE, MORE_FORCE, MissingForces, missing_forces
from torchrl_h2o.residuals.measured.transitions import Split
from torchrl_h2o.residuals.progress import LoopBar
from torchrl_h2o.residuals.trace.add import sketched_set
from torchrl_h2o.residuals.trace.choose_horizon import longer_windows, possible_horizons
from torchrl_h2o.residuals.trace.fit import Fit
from torchrl_h2o.residuals.trace.grow import comparable_losses
from torchrl_h2o.residuals.trace.inverse_dynamics import PROPOSED, propose_effects
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.rescale import NOISE_FREE_LOSS
from torchrl_h2o.residuals.trace.screening import is_possible, screen
from torchrl_h2o.residuals.trace.state import SearchState

# replaces ``MORE_FORCE`` for effects that predict the motion, beyond a regression's proposal that takes their place
MORE_FORCE_IF_STANDS = 3.0
# share of each missing force that effects may leave and keep their place, if they predict the motion
FORCE_LEFT_IF_STANDS = 0.05
LEAST_SECONDS = 0.1  # length of the windows with which the search begins anew, in s, if the data hold enough of them

PROPOSAL = 0.1  # share by which a regression, a screening, or the fit of a proposal brings the bar closer to the end


def begin_with(state: SearchState, known: Sequence[Effect]) -> SearchState:
    """Puts known effects into a search that has found nothing yet, and fits them.

    Args:
        state: the state at the beginning.
        known: the effects; those that are not in the catalogue are left out.

    Returns:
        The state with the effects, unchanged if the model rejects them.
    """
    pairs = [(entry, effect) for effect in known if (entry := entry_of(effect, state.catalogue)) is not None]
    if not pairs or not is_possible(state.problem, [effect for _, effect in pairs]):
        return state
    entries, effects = zip(*pairs, strict=True)
    return _with_rivals(state.with_found(entries, state.refitted(entries, effects)))


def _with_rivals(state: SearchState, advance: Callable[[], object] = lambda: None) -> SearchState:
    """The state with the leads that a screening without each of its effects gives; ``advance`` follows each entry."""
    rivals, found = {}, {entry.name for entry in state.entries}
    for entry, effect in zip(state.entries, state.fit.effects, strict=True):
        others = [other for other in state.fit.effects if other is not effect]
        candidates = [one for one in state.catalogue if one.name == entry.name or one.name not in found]
        possible = is_possible(state.problem, others)  # less damping than the model has may need the other effects
        rivals[entry.name] = (
            screen(state.problem, others, candidates, state.windows.screened, advance) if possible else []
        )
    return replace(state, rivals=rivals)


def _with_rivals_shown(state: SearchState, progress: LoopBar) -> SearchState:
    """The same, with a bar that comes closer after each entry."""
    return _with_rivals(state, partial(progress.closer, PROPOSAL / (len(state.catalogue) * len(state.entries))))


def begin_anew(
    state: SearchState, catalogue: Sequence[CatalogueEntry], rng: np.random.Generator, progress: LoopBar
) -> SearchState | None:
    """Begins another search if the first one explains no motion: with longer windows, and proposed effects.

    Windows of one control step are too short where the motion in them is smaller than the sensors' noise: a joint that
    keeps its velocity is then as good as the right effects. Properties of links and joints of the kinds that the first
    search has found are left out of the other one, unless the regression proposes them.

    Args:
        state: what the first search has found.
        catalogue: effects that the simulator may lack.
        rng: generator for screened windows.
        progress: bar that shows how far the search is.

    Returns:
        The state with the proposed effects; None if the effects found explain motion, or the proposed
        ones do not.
    """
    if not state.entries or _explains_motion(state):
        return None
    kept_still = {type(entry.effect) for entry in state.entries}.intersection(PROPOSED)
    proposed = _with_proposed(state, catalogue, rng, progress, kept_still)
    if proposed is None or not _explains_motion(proposed):
        return None
    return _with_rivals_shown(proposed, progress)


def begin_with_forces(
    state: SearchState, catalogue: Sequence[CatalogueEntry], rng: np.random.Generator, progress: LoopBar
) -> SearchState | None:
    """Begins another search with the effects that a regression of the missing forces proposes, if they explain more.

    Effects that are put in one by one must each explain something alone. Where a mass, friction and a constant force
    are missing together, none of them may, or a wrong mass may take the place of two of them.

    Args:
        state: what the first search has found.
        catalogue: effects that the simulator may lack.
        rng: generator for screened windows.
        progress: bar that shows how far the search is.

    Returns:
        The state with the proposed effects, fitted to the motion; None if hardly any force is still missing, or if the
        proposed effects do not leave far smaller forces and significantly smaller errors of the motion.
    """
    found = None if state.exact else _missing_forces(state)
    if found is None or found.hardly_any():
        return None
    proposed = _with_proposed(state, catalogue, rng, progress)
    if proposed is None or (forces := _missing_forces(proposed)) is None:
        return None
    if not MissingForces(found.after, forces.after).fall_by(LESS_FORCE):
        return None
    same_windows = _refitted_at(state, SearchState.begin(proposed.problem, catalogue, rng, state.settings))
    proposed = proposed.rescaled(proposed.posed_at(proposed.fit.effects))
    mine, its = comparable_losses([same_windows, proposed])
    if its.mean() > mine.mean() or proposed.p_value(mine, its) > state.settings.level:
        return None
    return _with_rivals_shown(proposed, progress)


def replaced_by_forces(
    state: SearchState, catalogue: Sequence[CatalogueEntry], rng: np.random.Generator, progress: LoopBar
) -> SearchState | None:
    """The effects that a regression of the missing forces proposes, where those found do not stand a test.

    Measured torques that are noisy move a light link in the simulator far more than they moved it in reality. A search
    that compares motion then finds rotors so heavy that the noise does not move them, even where windows are long.

    Args:
        state: what a search has found.
        catalogue: effects that the simulator may lack.
        rng: generator for screened windows.
        progress: bar that shows how far the search is.

    Returns:
        The state with the proposed effects, at the values of the regression because noisy torques would distort a fit
        to the motion as well. Effects found that no regression proposes, such as a delay, stay beside them unless far
        less force is missing without them. None if hardly any force is missing with the effects found; or if the
        proposed ones raise the error of the motion, or do not leave smaller forces missing: far smaller ones if the
        effects found predict the motion of their joints and do not raise the missing forces.
    """
    found = None if state.exact or not state.entries else _missing_forces(state)
    if found is None or found.hardly_any():
        return None
    stands = _stands(state, found)
    if stands and found.hardly_any(FORCE_LEFT_IF_STANDS):
        return None
    others = [index for index, effect in enumerate(state.fit.effects) if not isinstance(effect, PROPOSED)]
    proposed = [
        _with_proposed(state, catalogue, rng, progress, kept=kept) for kept in ([others, []] if others else [[]])
    ]
    possible = [(one, forces) for one in proposed if one is not None and (forces := _missing_forces(one)) is not None]
    if not possible:
        return None
    (best, forces) = possible[0]
    if MissingForces(possible[-1][1].after, forces.after).rise_by(MORE_FORCE):
        best, forces = possible[-1]
    without, with_them = (best.first.selection_loss(which) for which in ((), best.fit.effects))
    explains = forces.fall_by(LESS_FORCE) and with_them < without
    factor = MORE_FORCE_IF_STANDS if stands else MORE_FORCE
    return best if explains and MissingForces(forces.after, found.after).rise_by(factor) else None


def _stands(state: SearchState, forces: MissingForces) -> bool:
    """Whether the effects found predict the motion of their joints, and do not raise the missing forces."""
    effects = state.fit.effects
    mended = state.first.simulation.with_effects(*effects)
    errors = errors_ahead(mended, state.first.measured, Split.SELECTION)
    moves = explains_motion(errors, BETTER_THAN_GUESS)
    unpredicted = effects_on_unpredicted_joints(mended, errors, effects, BETTER_THAN_GUESS)
    return moves and not unpredicted and not forces.rise_by(MORE_FORCE)


def _missing_forces(state: SearchState) -> MissingForces | None:
    """The missing forces of the selection part without and with the effects found."""
    simulation, measured = state.first.simulation, state.first.measured
    mended = simulation.with_effects(*state.fit.effects)
    return missing_forces(simulation, mended, measured, Split.SELECTION)


def _with_proposed(
    state: SearchState,
    catalogue: Sequence[CatalogueEntry],
    rng: np.random.Generator,
    progress: LoopBar,
    left_out: Collection[type[Effect]] = (),
    kept: Sequence[int] | None = None,
) -> SearchState | None:
    """Another search, in longer windows, with the effects that a regression of the missing forces proposes.

    Args:
        state: what the first search has found.
        catalogue: effects that the simulator may lack.
        rng: generator for screened windows.
        progress: bar that shows how far the search is.
        left_out: kinds of effects that the other search does not try, unless they are proposed.
        kept: indices of the effects found that stay beside the proposed ones. All keep their values then; by default
            none stays, and the proposed ones are fitted to the motion.

    Returns:
        The state; None if nothing is proposed, or the model rejects it.
    """
    simulation, measured, settings = state.first.simulation, state.first.measured, state.settings
    before = state.fit.only(kept or ())
    found = propose_effects(
        simulation.with_effects(*before.effects),
        measured,
        catalogue,
        lambda: progress.closer(PROPOSAL / len(catalogue)),
    )
    if not found.entries:
        return None
    lengths = possible_horizons(simulation, measured, state.settings)
    long_enough = [steps for steps in lengths if steps * simulation.control_step >= LEAST_SECONDS]
    horizon = min(long_enough, default=lengths[-1])
    problem = Problem.pose(simulation, measured, horizon)
    if not is_possible(problem, [*before.effects, *found.effects]):
        return None
    searched = [entry for entry in catalogue if entry in found.entries or type(entry.effect) not in left_out]
    other = SearchState.begin(problem, searched, rng, settings)
    progress.closer(PROPOSAL)
    if kept is None:
        return other.with_found(found.entries, other.refitted(found.entries, found.effects))
    effects = (*before.effects, *found.effects)
    moved = (*before.free, *(tuple(widths) for widths in found.half_widths))
    fit = Fit(effects, moved, other.screened_loss(effects), (*before.half_widths, *found.half_widths))
    return other.with_found([*(state.entries[index] for index in kept), *found.entries], fit)


def begin_noise_free(
    state: SearchState, catalogue: Sequence[CatalogueEntry], rng: np.random.Generator, progress: LoopBar
) -> SearchState | None:
    """Begins another search, as if the sensors had no noise, if noise does not explain what is left.

    The noise of a sensor is estimated from the residual. While an effect is missing, the estimate may therefore contain
    that effect: a sensor's wrong gain changes successive residuals as noise does, and is then not looked for any more.
    Windows that were lengthened for such noise may also keep a fit from the right value. No effect explains most of
    real noise, and no other values of the effects found do.

    Args:
        state: what the search with noisy sensors has found.
        catalogue: effects that the simulator may lack.
        rng: generator for screened windows.
        progress: bar that shows how far the search is.

    Returns:
        The state with the same effects, refitted in windows of one control step; None if neither these nor one more
        effect explain most of what is left there, or if the noise is known because columns were estimated.
    """
    noisy, measured = state.problem, state.problem.measured
    estimated = measured.estimated_std is not None and bool(measured.estimated_std.any())
    if state.exact or noisy.sensor_std is None or estimated:
        return None
    problem = Problem.pose(noisy.simulation, measured, 1, sensor_std=measured.no_noise)
    silent = replace(SearchState.begin(problem, catalogue, rng, state.settings), noise_free=True)
    silent = _refitted_at(state, silent)
    to_beat = NOISE_FREE_LOSS * silent.screened_loss(state.fit.effects)
    refitted = silent.screened_loss(silent.fit.effects)
    advance = partial(progress.closer, PROPOSAL / (len(catalogue) * max(1, len(state.entries))))
    if refitted > to_beat and _loss_with_one_more(silent, advance) > to_beat:
        return None
    return _with_rivals(silent, advance)


def begin_in_longer_windows(
    state: SearchState, catalogue: Sequence[CatalogueEntry], rng: np.random.Generator, progress: LoopBar
) -> SearchState | None:
    """Begins another search in longer windows, from the effects found, where sensors are noisy.

    Two effects that look alike in one step differ in longer windows. In one step, dry friction that is fitted too high
    may explain viscous friction as well, because the noise of the start states hides when the joint turns around.

    All effects found stay at the beginning, also those that longer windows do not need: one that stands for another
    effect, such as a dead band for a constant force, leads to it among its alternatives.

    Args:
        state: what the search in shorter windows has found.
        catalogue: effects that the simulator may lack.
        rng: generator for screened windows.
        progress: bar that shows how far the search is.

    Returns:
        The state with the same effects, refitted in longer windows; None if nothing was found, or there are no longer
        windows.
    """
    if (longer := in_longer_windows(state, catalogue, rng)) is None:
        return None
    return _with_rivals_shown(longer, progress)


def in_longer_windows(
    state: SearchState, catalogue: Sequence[CatalogueEntry], rng: np.random.Generator
) -> SearchState | None:
    """The effects found, refitted in longer windows and without rivals.

    Args:
        state: what a search in shorter windows has found.
        catalogue: effects that the simulator may lack.
        rng: generator for screened windows.

    Returns:
        The state; None if nothing was found, if only rounding is left, or if there are no longer windows.
    """
    steps = longer_windows(state.problem)
    if state.exact or not state.entries or steps is None:
        return None
    problem = Problem.pose(state.first.simulation, state.first.measured, steps)
    return _refitted_at(state, SearchState.begin(problem, catalogue, rng, state.settings))


def _refitted_at(found: SearchState, other: SearchState) -> SearchState:
    """Another search with the effects found: residuals scaled by what these leave, and the effects fitted again."""
    other = other.rescaled(other.posed_at(found.fit.effects))
    return other.with_found(found.entries, other.refitted(found.entries, found.fit.effects))


def _loss_with_one_more(state: SearchState, advance: Callable[[], object]) -> float:
    """Mean loss of the screened windows in a quick fit with the most promising entry; infinite without one."""
    leads = screen(state.problem, state.fit.effects, state.others, state.windows.screened, advance)
    if not leads or leads[0].promise <= 0.0:
        return math.inf
    sketch = sketched_set(state, [*state.fit.effects, leads[0].effect], leads[:1])
    return math.inf if sketch is None else sketch.loss


def _explains_motion(state: SearchState) -> bool:
    """Whether the effects found predict the selection windows better than the guess of constant velocities."""
    mended = state.first.simulation.with_effects(*state.fit.effects)
    errors = errors_ahead(mended, state.first.measured, Split.SELECTION)
    return explains_motion(errors, BETTER_THAN_GUESS)
