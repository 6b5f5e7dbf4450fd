"""Tests one value for several joints or motors against one value each, such as the friction of a hip and of a knee."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from torchrl_h2o.effects import CatalogueEntry, Effect, selection
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.trace.problem import matters
from torchrl_h2o.residuals.trace.screening import free_parameters, is_possible
from torchrl_h2o.residuals.trace.state import SearchState


def divide_by_element(state: SearchState) -> SearchState:
    """Replaces each effect on several joints or motors by one effect each, where that lowers the loss significantly.

    One value for all is the simpler explanation and is found first; a hip and a knee may still differ.

    Args:
        state: effects found.

    Returns:
        The state with the divided effects; unchanged where one value for all explains the data as well.
    """
    for entry in state.entries:
        state = _divided(state, entry)
    return state


def entries_of_elements(
    entry: CatalogueEntry, catalogue: Sequence[CatalogueEntry], simulation: Simulation
) -> tuple[CatalogueEntry, ...]:
    """The entries with the same effect on each of the joints or motors of an entry; empty if it acts on fewer than two.

    Args:
        entry: an entry of the catalogue.
        catalogue: all entries.
        simulation: simulator, for the names of its joints and motors.
    """
    own = elements(entry.effect, simulation)
    if len(own) < 2:
        return ()
    alike = [other for other in catalogue if type(other.effect) is type(entry.effect)]
    alone = {acted_on[0]: other for other in alike if len(acted_on := elements(other.effect, simulation)) == 1}
    return tuple(alone[one] for one in own) if alone.keys() >= set(own) else ()


def elements(effect: Effect, simulation: Simulation) -> tuple[str | int, ...]:
    """Names of the joints, or indices of the motors, that an effect acts on; empty for other effects."""
    if (joints := getattr(effect, "joints", None)) is not None:
        return tuple(joint.name for joint in selection.joints(simulation.spec(), joints))
    if hasattr(effect, "actuators"):
        chosen = getattr(effect, "actuators", None)
        return tuple(range(simulation.model.nu)) if chosen is None else chosen
    return ()


def _divided(state: SearchState, entry: CatalogueEntry) -> SearchState:
    rules, present = state.settings.trace, state.fit.effects
    index = state.entries.index(entry)
    singles = entries_of_elements(entry, state.catalogue, state.problem.simulation)
    if not singles or {single.name for single in singles} & {other.name for other in state.entries}:
        return state
    values = {name: getattr(present[index], name) for name in free_parameters(entry)}
    starts = tuple(single.effect.with_parameters(values) for single in singles)
    effects = (*present[:index], *starts, *present[index + 1 :])
    if not is_possible(state.problem, effects):
        return state
    entries = (*state.entries[:index], *singles, *state.entries[index + 1 :])
    before = state.selection_losses(present)
    fitted = state.refitted(entries, effects)
    after = state.selection_losses(fitted.effects)
    least = rules.min_gain if state.problem.sensor_std is None else rules.min_gain_under_noise
    pays = after.mean() < (1.0 - least) * before.mean() and matters(
        state.first_loss,
        state.first.selection_loss(present),
        state.first.selection_loss(fitted.effects),
        (len(singles) - 1) * rules.min_share,
    )
    if not (pays and state.p_value(before, after) < state.settings.significance.level):
        return state
    rivals = {**state.rivals, **{single.name: state.rivals[entry.name] for single in singles}}
    groups = (*state.groups[:index], *(() for _ in singles), *state.groups[index + 1 :])
    return replace(state, entries=entries, fit=fitted, rivals=rivals, groups=groups)
