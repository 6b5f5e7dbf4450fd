"""Tests one value for several joints or motors against one value each, such as the friction of a hip and of a knee."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from torchrl_h2o.effects import CatalogueEntry, Effect, Parameter
from torchrl_h2o.residuals.trace.families import acted_on, entries_of_elements
from torchrl_h2o.residuals.trace.noise_gain import explained_by_noise
from torchrl_h2o.residuals.trace.problem import MIN_GAIN, MIN_GAIN_UNDER_NOISE, losses, matters
from torchrl_h2o.residuals.trace.screening import are_possible_alone, free_parameters, is_possible
from torchrl_h2o.residuals.trace.significance import BEYOND_NOISE
from torchrl_h2o.residuals.trace.state import SearchState


def divide_by_element(state: SearchState, rng: np.random.Generator) -> SearchState:
    """Replaces effects on several joints or motors by one effect each, where that lowers the loss significantly.

    One value for all is the simpler explanation and is found first; a hip and a knee may still differ. Effects that are
    divided without a further value, such as one on both joints and one on the knee, need no lower loss. The division
    that lowers the loss most is tested first, because dividing one effect may compensate a wrong value of another.

    Args:
        state: effects found.
        rng: generator of synthetic noise.

    Returns:
        The state with the divided effects; unchanged where fewer values explain the data as well.
    """
    while True:
        divisions = [divided for entry in state.entries if (divided := _divided(state, entry)) is not None]
        divisions.sort(key=lambda divided: float(divided.selection_losses(divided.fit.effects).mean()))
        state, before = next((divided for divided in divisions if _pays(state, divided, rng)), state), state
        if state is before:
            return state


def divided_where_shared_harms(state: SearchState) -> SearchState:
    """Replaces an effect on several joints or motors by one effect each, where it raises the error of one of them.

    One value for all lowers the sum of the errors, also if what some joints gain exceeds what another one loses. An
    effect of its own may then have a smaller value at that joint, or none.

    Args:
        state: effects found.
    """
    for entry in state.entries:
        if _harms_one(state, entry) and (divided := _divided(state, entry)) is not None:
            before, after = (which.selection_losses(which.fit.effects).mean() for which in (state, divided))
            return divided_where_shared_harms(divided) if after < before else state
    return state


def _harms_one(state: SearchState, entry: CatalogueEntry) -> bool:
    """Whether an effect raises the error of what is observed of one of its joints, by the rows that choose effects."""
    simulation, index = state.problem.simulation, state.entries.index(entry)
    if len(joints := acted_on(entry.effect, simulation)) < 2:
        return False
    without, with_it = (
        state.problem.selection_residuals(which.effects) for which in (state.fit.without(index), state.fit)
    )
    model, observed = simulation.model, simulation.state_map.restore_observed
    level = state.settings.level / len(joints)
    for joint in joints:
        rows = [model.jnt_qposadr[joint], model.nq + model.jnt_dofadr[joint]]
        seen = np.flatnonzero(observed[rows].any(0))
        if not len(seen):
            continue
        before, after = (losses(residual[..., seen]) for residual in (without, with_it))
        if after.mean() > before.mean() / (1.0 - MIN_GAIN) and state.p_value(after, before) < level:
            return True
    return False


def _divided(state: SearchState, entry: CatalogueEntry) -> SearchState | None:
    """The state with one effect for each of an entry's elements, fitted; None if that is not possible.

    An element that already has an effect of this kind for itself keeps one effect, which starts from both together: the
    friction of all joints and more of the knee becomes the friction of the hip and that of the knee.
    """
    singles = entries_of_elements(entry, state.catalogue, state.problem.simulation)
    if not singles:
        return None
    found = list(zip(state.entries, state.fit.effects, strict=True))
    names = {single.name for single in singles}
    before, whole = state.entries.index(entry), state.fit.effects[state.entries.index(entry)]
    own = {other.name: effect for other, effect in found if other.name in names}
    divided = [(single, _together(whole, own.get(single.name, single.effect))) for single in singles]
    kept = [[pair for pair in part if pair[0].name not in names] for part in (found[:before], found[before + 1 :])]
    entries, starts = zip(*kept[0], *divided, *kept[1], strict=True)
    if not is_possible(state.problem, starts):
        return None
    fitted = state.refitted(entries, starts)
    if not are_possible_alone(state.problem, fitted.effects):
        return None
    rivals = {**{single.name: state.rivals.get(entry.name, ()) for single in singles}, **state.rivals}
    return replace(state, entries=entries, fit=fitted, rivals=rivals, groups=())


def _together(whole: Effect, own: Effect) -> Effect:
    """An element's own effect with the values that it has together with one on several elements."""
    return own.with_parameters(
        {name: _composed(parameter, whole.parameters[name].value) for name, parameter in own.parameters.items()}
    )


def _composed(parameter: Parameter, other: float) -> float:
    """A parameter's value and another one together: the product of factors, the smaller limit, else the sum."""
    if parameter.neutral == 1.0:
        value = parameter.value * other
    elif math.isfinite(parameter.neutral):
        value = parameter.value + other - parameter.neutral
    else:
        value = min(parameter.value, other, key=abs)
    return float(np.clip(value, *parameter.bounds))


def _pays(state: SearchState, divided: SearchState, rng: np.random.Generator) -> bool:
    """Whether a division lowers the loss significantly, and by more than rounding or noise would make it."""
    noisy = state.problem.sensor_std is not None
    before, after = (which.selection_losses(which.fit.effects) for which in (state, divided))
    if len(divided.entries) <= len(state.entries):  # as many values, in plainer words
        return state.p_value(after, before) >= state.settings.level
    gain = 1.0 - after.mean() / before.mean()
    least = MIN_GAIN_UNDER_NOISE if noisy else MIN_GAIN
    if gain <= least or state.p_value(before, after) >= state.settings.level:
        return False
    if noisy:  # the total reduction includes the noise, so a share of it is no criterion
        free = [free_parameters(entry) for entry in divided.entries]
        return gain > BEYOND_NOISE * explained_by_noise(state, divided.fit.effects, free, rng)
    one, each = (state.first.selection_loss(which.fit.effects) for which in (state, divided))
    added = len(divided.entries) - len(state.entries)
    return matters(state.first_loss, one, each, added * state.min_share)
