"""Begins a search with effects that are known already, such as those of an unfinished run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from torchrl_h2o.effects import CatalogueEntry, Effect
from torchrl_h2o.residuals.trace.screening import is_possible, screen
from torchrl_h2o.residuals.trace.state import SearchState


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
    rivals = {}
    for entry, effect in pairs:
        others = [other for other in effects if other is not effect]
        candidates = [one for one in state.catalogue if one is entry or one not in entries]
        rivals[entry.name] = screen(state.problem, others, candidates, state.windows.screened)
    return replace(state, rivals=rivals).with_found(entries, state.refitted(entries, effects))


def entry_of(effect: Effect, catalogue: Sequence[CatalogueEntry]) -> CatalogueEntry | None:
    """The entry with the same effect at its neutral value; None if the catalogue has none."""
    neutral = effect.with_parameters({name: p.neutral for name, p in effect.parameters.items()})
    return next((entry for entry in catalogue if entry.effect == neutral), None)
