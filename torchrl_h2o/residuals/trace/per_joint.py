"""Tests one value for several joints or motors against one value each, such as the friction of a hip and of a knee."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from torchrl_h2o.effects import CatalogueEntry
from torchrl_h2o.residuals.trace.families import entries_of_elements
from torchrl_h2o.residuals.trace.noise_gain import explained_by_noise
from torchrl_h2o.residuals.trace.problem import matters
from torchrl_h2o.residuals.trace.screening import are_possible_alone, free_parameters, is_possible
from torchrl_h2o.residuals.trace.state import SearchState


def divide_by_element(state: SearchState, rng: np.random.Generator) -> SearchState:
    """Replaces effects on several joints or motors by one effect each, where that lowers the loss significantly.

    One value for all is the simpler explanation and is found first; a hip and a knee may still differ. The division
    that lowers the loss most is tested first, because dividing one effect may compensate a wrong value of another.

    Args:
        state: effects found.
        rng: generator of synthetic noise.

    Returns:
        The state with the divided effects; unchanged where one value for all explains the data as well.
    """
    while True:
        divisions = [divided for entry in state.entries if (divided := _divided(state, entry)) is not None]
        divisions.sort(key=lambda divided: float(divided.selection_losses(divided.fit.effects).mean()))
        state, before = next((divided for divided in divisions if _pays(state, divided, rng)), state), state
        if state is before:
            return state


def _divided(state: SearchState, entry: CatalogueEntry) -> SearchState | None:
    """The state with one effect for each of an entry's elements, fitted; None if that is not possible."""
    present, index = state.fit.effects, state.entries.index(entry)
    singles = entries_of_elements(entry, state.catalogue, state.problem.simulation)
    if not singles or {single.name for single in singles} & {other.name for other in state.entries}:
        return None
    values = {name: getattr(present[index], name) for name in free_parameters(entry)}
    starts = tuple(single.effect.with_parameters(values) for single in singles)
    effects = (*present[:index], *starts, *present[index + 1 :])
    if not is_possible(state.problem, effects):
        return None
    entries = (*state.entries[:index], *singles, *state.entries[index + 1 :])
    fitted = state.refitted(entries, effects)
    if not are_possible_alone(state.problem, fitted.effects):
        return None
    rivals = {**{single.name: state.rivals[entry.name] for single in singles}, **state.rivals}
    return replace(state, entries=entries, fit=fitted, rivals=rivals, groups=())


def _pays(state: SearchState, divided: SearchState, rng: np.random.Generator) -> bool:
    """Whether a division lowers the loss significantly, and by more than rounding or noise would make it."""
    rules, noisy = state.settings.trace, state.problem.sensor_std is not None
    before, after = (which.selection_losses(which.fit.effects) for which in (state, divided))
    gain = 1.0 - after.mean() / before.mean()
    least = rules.min_gain_under_noise if noisy else rules.min_gain
    if gain <= least or state.p_value(before, after) >= state.settings.significance.level:
        return False
    if noisy:  # the total reduction includes the noise, so a share of it is no criterion
        free = [free_parameters(entry) for entry in divided.entries]
        return gain > rules.beyond_noise * explained_by_noise(state, divided.fit.effects, free, rng)
    one, each = (state.first.selection_loss(which.fit.effects) for which in (state, divided))
    added = len(divided.entries) - len(state.entries)
    return matters(state.first_loss, one, each, added * state.min_share)
