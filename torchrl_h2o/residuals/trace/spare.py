"""Takes an alternative in the place of an effect if it makes another effect unnecessary."""

from __future__ import annotations

from torchrl_h2o.residuals.trace.close_comparison import worse_of
from torchrl_h2o.residuals.trace.eliminate import eliminate, is_worse
from torchrl_h2o.residuals.trace.screening import free_parameters
from torchrl_h2o.residuals.trace.simplify import replaced
from torchrl_h2o.residuals.trace.state import SearchState


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
