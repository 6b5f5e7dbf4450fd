"""Effects of a usual size that data could not have shown: noise hides them, or the motion does not excite them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from torchrl_h2o.effects import CatalogueEntry, Effect
from torchrl_h2o.effects.effect import NO_NAMES, EntryNames
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.report.words import effect_words
from torchrl_h2o.residuals.settings import DEFAULTS, LoopSettings
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.trace.problem import Problem, losses
from torchrl_h2o.residuals.trace.significance import p_value_of_losses

NAMED = 5  # kinds of effects that the sentence names


def undetectable_effects(
    simulation: Simulation,
    measured: Measured,
    catalogue: Sequence[CatalogueEntry],
    horizon: int = 1,
    advance: Callable[[], object] = lambda: None,
    settings: LoopSettings = DEFAULTS,
) -> tuple[Effect, ...]:
    """Finds the effects that a search would have missed if they had been there.

    For the largest trials of each entry, the search's own test is repeated on residuals to which the trial's change is
    added: the effect is found if it then explains the share of the loss that an addition must explain, significantly.

    Args:
        simulation: the simulator, to which nothing was added.
        measured: the data.
        catalogue: the entries that the search tried; those of random effects are left out.
        horizon: control steps per window of the search.
        advance: called after each entry.
        settings: thresholds of the search.

    Returns:
        The effects at the trials that would be missed; of an entry with several parameters, one where all would be.
    """
    problem = Problem.pose(simulation, measured, horizon, settings=settings.residual)
    level = settings.significance.level / max(1, len(catalogue))
    judged = measured.selected_on(horizon)
    right = problem.residual((), judged)

    def is_missed(effect: Effect) -> bool:
        try:
            change = right - problem.residual((effect,), judged)
        except ValueError:  # a value that the model rejects, such as negative damping
            return False
        before, after = losses(right + change), losses(right)
        least = settings.trace.min_gain if problem.sensor_std is None else settings.trace.min_gain_under_noise
        small = before.mean() - after.mean() <= least * before.mean()
        return bool(small or p_value_of_losses(before, after, settings.significance) >= level)

    missed = []
    for entry in catalogue:
        largest = () if entry.effect.random else _largest(entry)
        missed_here = [effect for effect in largest if is_missed(effect)]
        if len(entry.fitted) == 1:
            missed += missed_here
        elif largest and len(missed_here) == len(largest):
            missed.append(missed_here[0])
        advance()
    return tuple(missed)


def _largest(entry: CatalogueEntry) -> list[Effect]:
    """The effect at its largest trials: of one parameter, one on each side of the neutral value; else all of them."""
    if len(entry.fitted) > 1:
        return list(entry.starts)
    [name] = entry.fitted
    values, neutral = [trial[name] for trial in entry.trials], entry.effect.parameters[name].neutral
    if math.isfinite(neutral):
        least, most = min(values), max(values)
        values = [value for value, is_end in ((least, least < neutral), (most, most > neutral)) if is_end]
    return [entry.effect.with_parameters({name: value}) for value in values]


def undetectable_words(effects: Sequence[Effect], names: EntryNames = NO_NAMES) -> tuple[str, ...]:
    """The effects that data could not have shown in a sentence, one of each kind; no sentence without any.

    Args:
        effects: the effects, in the order of the catalogue, which begins with the most elements.
        names: names of the observations, for the words.
    """
    of_kinds = list({type(effect): effect for effect in reversed(effects)}.values())[::-1]
    if not of_kinds:
        return ()
    words = [effect_words(effect, names=names) for effect in of_kinds[:NAMED]]
    if more := len(effects) - len(words):
        words.append(f"{more} more effect{'s' if more > 1 else ''} of the catalogue")
    listed = " or ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else words[0]
    return (f"These data could not have shown: {listed}.",)
