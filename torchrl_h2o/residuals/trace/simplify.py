"""Replaces each effect by the simplest and most usual one with an equivalent loss, and records the alternatives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from torchrl_h2o.effects.catalogue.plausibility import surprise
from torchrl_h2o.residuals.trace.alternatives import alternatives, p_value_between
from torchrl_h2o.residuals.trace.close_comparison import SAME_LOSS, refined, worse_of
from torchrl_h2o.residuals.trace.eliminate import eliminate, is_worse
from torchrl_h2o.residuals.trace.outcome import Attempt, Question
from torchrl_h2o.residuals.trace.rescale import rescale
from torchrl_h2o.residuals.trace.screening import free_parameters
from torchrl_h2o.residuals.trace.state import SearchState


def simplify(state: SearchState, advance: Callable[[], object] = lambda: None) -> SearchState:
    """Simplifies the effects found one by one; the state's groups then hold the alternatives of each.

    The most unusual effect comes first, because it is the most likely one to stand in for another. Ends without groups
    as soon as a better effect leaves only rounding, because the alternatives found so far depend on this. If an effect
    was examined beside the same others in an earlier round, the alternatives of that round are used.

    Args:
        state: effects found.
        advance: called after each entry that was tried in an effect's place.
    """
    state, exact, groups = replace(state, groups=()), state.exact, {}
    for index in sorted(range(len(state.entries)), key=lambda i: -surprise(state.fit.effects[i])):
        if (known := state.alternatives.get(_question(state, index))) is not None:
            groups[index] = known
            continue
        state, groups[index] = simplify_one(state, index, advance)
        if state.exact and not exact:
            return replace(state, groups=())
        state = replace(state, alternatives={**state.alternatives, _question(state, index): groups[index]})
    return replace(state, groups=tuple(groups[index] for index in range(len(state.entries))))


def _question(state: SearchState, index: int) -> Question:
    """Key under which the alternatives of an effect are stored."""
    return Question(state.entries[index].name, frozenset(entry.name for entry in state.entries), state.exact)


def simplify_one(
    state: SearchState, index: int, advance: Callable[[], object] = lambda: None
) -> tuple[SearchState, tuple[Attempt, ...]]:
    """Replaces one effect by the equivalent one with the fewest parameters, and among these by the most usual one.

    Where the data do not decide, effects that are common on real machines are preferred: rotor inertia to a body with
    three times its inertia, friction to a motor at 30 % of its gain.

    Args:
        state: effects found so far.
        index: position of the effect.
        advance: called after each entry that was tried in its place.

    Returns:
        The state, with residuals scaled by their size without the effect, and the other equivalent effects. If a better
        effect leaves only rounding, the state with this effect, and no others.
    """
    exact = state.exact
    state, as_good = _with_better_alternative(state, index, advance)
    if state.exact and not exact:
        return state, ()
    own_loss = float(state.selection_losses(state.fit.effects).mean())
    group = [Attempt(state.entries[index], state.fit, index, own_loss, 1.0), *as_good]
    # min() returns the first of equals, the effect itself;
    # otherwise two equivalent delays would replace each other for ever
    simplest = min(group, key=lambda a: (len(free_parameters(a.entry)), surprise(a.effect)))
    rest = tuple(attempt for attempt in group if attempt is not simplest)
    return replaced(state, index, simplest), rest


def _with_better_alternative(
    state: SearchState, index: int, advance: Callable[[], object]
) -> tuple[SearchState, tuple[Attempt, ...]]:
    """Takes significantly better alternatives until there is none; returns the alternatives of the last effect.

    An effect may have been chosen before other effects were found, and may no longer be the best in its place.
    """
    seen = set()
    while True:
        seen.add(state.entries[index].name)
        state, as_good = alternatives(state, index, advance)
        state, as_good, better = _compared_closely(state, index, as_good)
        if not better or better[0].entry.name in seen:
            return state, as_good
        state = replaced(state, index, better[0])
        if state.problem.sensor_std is None and (rescaled := rescale(state)).exact:
            return rescaled, ()


def _compared_closely(
    state: SearchState, index: int, as_good: Sequence[Attempt]
) -> tuple[SearchState, tuple[Attempt, ...], list[Attempt]]:
    """Compares an effect with its alternatives, with residuals scaled by what each of them leaves.

    An alternative that differs from the effect by rounding is equally good; if the effects leave only rounding, all
    alternatives are. If an alternative is already significantly better with the present scales, nothing is refined.

    Returns:
        The state, the alternatives that are not worse than the effect, and those that are better.
    """
    equal, differing = _divided_by_rounding(state, index, as_good)
    if state.exact or not differing:
        return state, tuple(as_good), []
    level = state.settings.level
    better = [a for a in differing if p_value_between(state, state.problem, state.fit, a.fit) < level]
    if better:
        return state, tuple(as_good), better
    state = state.with_found(state.entries, refined(state, state.entries, state.fit))
    near = [replace(a, fit=refined(state, replaced(state, index, a).entries, a.fit)) for a in differing]
    worse = [worse_of(state, state.fit, a.fit) for a in near]
    better = [a for a, which in zip(near, worse, strict=True) if which is state.fit]
    return state, (*equal, *(a for a, which in zip(near, worse, strict=True) if which is not a.fit)), better


def _divided_by_rounding(
    state: SearchState, index: int, attempts: Sequence[Attempt]
) -> tuple[list[Attempt], list[Attempt]]:
    """Attempts whose loss differs from the effect's by a negligible share of the effect's gain, and the others."""
    effects = state.fit.effects
    with_it, without = (
        state.selection_losses(which).mean() for which in (effects, [*effects[:index], *effects[index + 1 :]])
    )
    negligible = SAME_LOSS * (without - with_it)
    equal = [attempt for attempt in attempts if abs(attempt.loss - with_it) <= negligible]
    return equal, [attempt for attempt in attempts if attempt not in equal]


def replaced(state: SearchState, index: int, attempt: Attempt) -> SearchState:
    """The state with an attempt in an effect's place; the new entry takes over the effect's rivals."""
    entries = tuple(attempt.entry if i == index else entry for i, entry in enumerate(state.entries))
    rivals = {**state.rivals, attempt.entry.name: state.rivals[state.entries[index].name]}
    return replace(state, entries=entries, fit=attempt.fit, rivals=rivals)


def spare(state: SearchState) -> SearchState:
    """Takes the first alternative beside which the other effects need fewer parameters; else the state itself.

    An effect that was added later may only correct a wrong one that was added before. Example: the larger wheels of a
    robot whose bodies are heavier need a gravity of 1.13 g beside them; with heavier bodies in their place, the fit
    brings gravity back to 1.000 g.

    Args:
        state: effects found, with the alternatives of each in ``groups``.
    """
    for index, group in enumerate(state.groups):
        for attempt in group:
            other = replaced(state, index, attempt)
            if not _has_spare(other, index):
                continue
            smaller = eliminate(other)
            if _parameters(smaller) < _parameters(state) and worse_of(state, smaller.fit, state.fit) is not smaller.fit:
                return smaller
    return state


def _has_spare(state: SearchState, kept: int) -> bool:
    """Whether the joint fit without one of the other effects, its values unchanged, is as good; saves most fits."""
    before = state.selection_losses(state.fit.effects)
    fewer = (state.fit.without(index) for index in range(len(state.entries)) if index != kept)
    return any(not is_worse(state, fit, before, state.selection_losses(fit.effects)) for fit in fewer)


def _parameters(state: SearchState) -> int:
    return sum(len(free_parameters(entry)) for entry in state.entries)
