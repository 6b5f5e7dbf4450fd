"""Effects that data could not have shown, because noise hides them or the motion does not excite them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from torchrl_h2o.effects import CatalogueEntry, Effect
from torchrl_h2o.effects.model.joint import LOCKED, JointRange
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.settings import DEFAULTS, LoopSettings
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.trace.choose_horizon import possible_horizons
from torchrl_h2o.residuals.trace.problem import MIN_GAIN, MIN_GAIN_UNDER_NOISE, Problem, losses
from torchrl_h2o.residuals.trace.screening import is_possible
from torchrl_h2o.residuals.trace.significance import p_value_of_losses


def undetectable_effects(
    simulation: Simulation,
    measured: Measured,
    catalogue: Sequence[CatalogueEntry],
    advance: Callable[[], object] = lambda: None,
    settings: LoopSettings = DEFAULTS,
) -> tuple[Effect, ...]:
    """Finds the effects that a search would have missed if they had been there.

    For the largest trials of each entry, the change by the trial is added to the residuals, and two conditions of the
    search are tested with windows of every possible length: the effect must explain the share of the loss that an
    addition must explain, and significantly. A search has further conditions, so it may miss more than is listed.

    Args:
        simulation: the simulator, to which nothing was added.
        measured: the data.
        catalogue: the entries that the search tried; those of random effects are left out.
        advance: called after each entry.
        settings: window lengths and significance level.

    Returns:
        The effects at the trials that would be missed; of an entry with several parameters one, if all trials would be
        missed. The effect of each kind that shows most comes first, then the others, in descending order of what shows.
    """
    level = settings.level / max(1, len(catalogue))
    lengths = [h for h in possible_horizons(simulation, measured, settings) if len(measured.selected_on(h))]
    if not lengths:
        return ()
    tests = [_Test(simulation, measured, horizon, level, settings) for horizon in lengths]
    missed: list[tuple[float, Effect]] = []
    for entry in catalogue:
        largest = [] if entry.effect.random else [e for e in _largest(entry) if is_possible(tests[0].problem, [e])]
        shares = {effect: share for effect in largest if (share := _share_if_missed(effect, tests)) is not None}
        if len(entry.fitted) == 1:
            missed += [(share, effect) for effect, share in shares.items()]
        elif shares and len(shares) == len(largest):
            effect = max(shares, key=lambda one: shares[one])
            missed.append((shares[effect], effect))
        advance()
    ranked = [effect for _, effect in sorted(missed, key=lambda pair: -pair[0])]
    first = {type(effect): effect for effect in reversed(ranked)}
    return tuple(sorted(ranked, key=lambda effect: effect is not first[type(effect)]))


class _Test:
    """The test of effects in windows of one length, on the part of the data by which effects are chosen."""

    def __init__(
        self, simulation: Simulation, measured: Measured, horizon: int, level: float, settings: LoopSettings
    ) -> None:
        self.problem = Problem.pose(simulation, measured, horizon)
        self.judged, self.level, self.settings = measured.selected_on(horizon), level, settings
        self.right = self.problem.residual((), self.judged)
        self.after = losses(self.right)

    def share(self, effect: Effect) -> tuple[float, bool]:
        """Share of the loss that an effect would explain if it were there, and whether a search would miss it."""
        change = self.right - self.problem.residual((effect,), self.judged)
        before, after = losses(self.right + change), self.after
        share = 1.0 - float(after.mean() / max(before.mean(), 1e-300))
        least = MIN_GAIN if self.problem.sensor_std is None else MIN_GAIN_UNDER_NOISE
        missed = share <= least or p_value_of_losses(before, after, self.settings) >= self.level
        return share, missed


def _share_if_missed(effect: Effect, tests: Sequence[_Test]) -> float | None:
    """Largest share of the loss that an effect would explain; None if a search would find it."""
    shares = []
    for test in tests:
        share, missed = test.share(effect)
        if not missed:
            return None
        shares.append(share)
    return max(shares)


def _largest(entry: CatalogueEntry) -> list[Effect]:
    """The effect at its largest trials: one on each side of a neutral value, the smallest limit, or all for several.

    Several parameters have no common order, so all of their trials are taken.
    """
    if len(entry.fitted) != 1:
        return list(entry.starts)
    [name] = entry.fitted
    values, neutral = [trial[name] for trial in entry.trials], entry.effect.parameters[name].neutral
    values = [value for value in values if not isinstance(entry.effect, JointRange) or value > LOCKED]
    least, most = min(values), max(values)
    ends = [least] if least < neutral else []
    ends += [most] if math.isfinite(neutral) and most > neutral else []
    return [entry.effect.with_parameters({name: value}) for value in ends]
