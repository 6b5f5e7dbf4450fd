"""Takes an alternative in the place of an effect if it makes another effect unnecessary."""

from __future__ import annotations

from torchrl_h2o.residuals.trace.close_comparison import worse_of
from torchrl_h2o.residuals.trace.eliminate import eliminate, is_worse_without
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
            if not any(_seems_spare(other, i) for i in range(len(other.entries)) if i != index):
                continue
            smaller = eliminate(other)
            if _parameters(smaller) < _parameters(state) and worse_of(state, smaller.fit, state.fit) is not smaller.fit:
                return smaller
    return state


def _seems_spare(state: SearchState, index: int) -> bool:
    """Whether the joint fit without one effect, its other values unchanged, is as good; spares most of the fits."""
    return not is_worse_without(state, state.fit.without(index))


def _parameters(state: SearchState) -> int:
    return sum(len(free_parameters(entry)) for entry in state.entries)
