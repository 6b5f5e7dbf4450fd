"""The verdict: whether anything is missing, whether the effects explain it, and whether to put them in."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from torchrl_h2o.effects import Effect, JointRange
from torchrl_h2o.effects.effect import EntryNames
from torchrl_h2o.likelihood import ENOUGH, Difference
from torchrl_h2o.residuals.estimated_states import sensor_noise
from torchrl_h2o.residuals.judge.caveats import friction_beside_noise, only_ratios
from torchrl_h2o.residuals.judge.headline import HEADLINE_WINDOWS
from torchrl_h2o.residuals.judge.prediction_table import NEGLIGIBLE, Predicted
from torchrl_h2o.residuals.judge.where import DESCRIBED_SHARE, where_it_is_large
from torchrl_h2o.residuals.measured.error_over_noise import errors_and_noise
from torchrl_h2o.residuals.measured.in_motion import in_motion
from torchrl_h2o.residuals.measured.residual import residuals
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.report.contents import (
    EXPLAINED,
    EXPLAINED_IN_PART,
    NOT_EXPLAINED,
    NOTHING_MISSING,
    Verdict,
)
from torchrl_h2o.residuals.report.errors import ErrorSummary, HeadlineError
from torchrl_h2o.residuals.report.sentence import headline_words
from torchrl_h2o.residuals.report.words import duration, effect_words, number, quantity
from torchrl_h2o.residuals.simulation.simulation import Simulation

AUTOCORRELATION = 0.2  # rank correlation of successive residuals above which they are not noise
FAR_SECONDS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # times ahead, in s, of which the longest that the data allow counts
# median error far ahead, in multiples of the median error by sensor noise, above which something is missing
FAR_RATIO = 2.0
FAR_NEGLIGIBLE = 0.01  # median error far ahead, in spreads, that is negligible without sensor noise
SMALL_REMAINDER = 0.02  # share of the error ahead below which the remaining error is not reported as a missing effect
RAISED = 1.1  # factor by which effects may raise the error in the report's sentence; beyond it they are not recommended
EXTREME_FACTOR = 20.0  # factor on a property of the model beyond which the value is reported as implausible
BLOCKS = 10  # blocks of the report's data in which the largest residual is looked for


def reach_verdict(
    simulation: Simulation,
    mended: Simulation,
    measured: Measured,
    effects: Sequence[Effect],
    error: ErrorSummary,
    predictions: Predicted | None,
    undetermined: Sequence[str] = (),
) -> Verdict:
    """Reaches a verdict from the part of the data that neither a fit nor a choice has used.

    Nothing is missing if there are no effects and neither a network that learns from what is left, nor the
    autocorrelation of the residuals, nor the error far ahead shows a difference. Otherwise the effects explain what is
    missing wholly, in part or not at all. Effects that raise the error of the report's sentence explain nothing, and a
    value that a machine hardly has is believed only if hardly an error is left with it.

    Args:
        simulation: the simulator before effects are put in.
        mended: the simulator with them.
        measured: the data.
        effects: the effects.
        error: errors before and after.
        predictions: how well the held-out motion is predicted; None if the data hold too few windows.
        undetermined: reasons against effects whose value the data leave open.
    """
    with_noise = simulation.with_effects(*effects)
    signs = signs_of_something_missing(with_noise, measured, error, predictions)
    if not effects:
        if not signs:
            return Verdict(NOTHING_MISSING)
        return Verdict(NOT_EXPLAINED, signs, recommended=False, where=where_most(mended, measured))
    against = reasons_against(simulation, effects, predictions)
    hardly = (
        () if predictions is None or error.headline is None else predictions.hardly_better(mended, _acting(effects))
    )
    against = (*against, *undetermined, *hardly)
    little = _leaves_little(error, predictions)
    odd, accepted = implausible_values(effects, simulation.names), ()
    if odd and little and not against:
        accepted = tuple(f"{one[0].upper()}{one[1:]}, but hardly an error is left with it." for one in odd)
    else:
        against = (*against, *odd)
    raised = False
    if (head := error.headline) is not None:
        worse = () if predictions is None else predictions.made_worse
        if raised := _raises(head, measured, simulation, effects):
            against = (*against, *(worse or (f"the effects found raise the error of {headline_words(head)}",)))
        else:
            signs = (*worse, *signs)
    caveats = (
        *friction_beside_noise(simulation, mended, effects),
        *only_ratios(simulation, effects),
        *accepted,
    )
    if raised or (signs and not little):
        where = where_most(mended, measured)
        kind = NOT_EXPLAINED if against else EXPLAINED_IN_PART
        return Verdict(kind, (*against, *signs), recommended=not against, where=where, caveats=caveats)
    return Verdict(NOT_EXPLAINED if against else EXPLAINED, against, recommended=not against, caveats=caveats)


def _raises(
    head: HeadlineError,
    measured: Measured,
    simulation: Simulation,
    effects: Sequence[Effect],
) -> bool:
    """Whether effects other than noise raise the error of the sentence, beyond what is negligible."""
    spread = float(measured.observation[:, simulation.state_map.names.index(head.name)].std())
    return bool(_acting(effects)) and head.after > max(RAISED * head.before, NEGLIGIBLE * spread)


def _leaves_little(error: ErrorSummary, predictions: Predicted | None) -> bool:
    """Whether hardly an error of the sentence's quantity is left, and of all quantities if a network learns from it.

    If it does, the error must also be small beside that of the guess that every velocity stays as it is. A simulator
    without the rotor of a light link is wrong by turns, and a hundredth of that says little.
    """
    head = error.headline
    if head is None or head.after >= SMALL_REMAINDER * head.before:
        return False
    if predictions is None or not predictions.learnt:
        return True
    if error.after >= SMALL_REMAINDER * error.before:
        return False
    total = predictions.table.rows[0]
    return total.mended.error < SMALL_REMAINDER * total.velocities_stay.error


def signs_of_something_missing(
    simulation: Simulation,
    measured: Measured,
    error: ErrorSummary,
    predictions: Predicted | None,
) -> tuple[str, ...]:
    """The tests by which a simulation with all effects still differs from the data, each in words with its figure."""
    signs = [] if predictions is None else [*predictions.learnt]
    correlations = {d.name: d.autocorrelation for d in error.per_dimension if d.autocorrelation is not None}
    high = {name: value for name, value in correlations.items() if np.isfinite(value) and value > AUTOCORRELATION}
    if high:
        name = max(high, key=lambda name: high[name])
        signs.append(f"successive residuals of {name} are alike (rank correlation {number(high[name], 2)})")
    far = _far_ahead(simulation, measured)
    return (*signs, *far)


def _far_ahead(simulation: Simulation, measured: Measured) -> tuple[str, ...]:
    """Whether the error far ahead exceeds what the sensors' noise causes."""
    names, units = simulation.state_map.names, simulation.state_map.units
    times = [max(1, round(seconds / simulation.control_step)) for seconds in FAR_SECONDS]
    possible = [steps for steps in times if len(measured.reported_on(steps)) >= HEADLINE_WINDOWS]
    if not possible:
        return ()
    steps = max(possible)
    spread = np.maximum(measured.observation.std(0), 1e-12)
    sensor_std = sensor_noise(simulation, measured)
    if sensor_std is None:
        sensor_std = np.zeros(len(names))
    starts = in_motion(measured, measured.reported_on(steps), steps, HEADLINE_WINDOWS)
    rng = np.random.default_rng(0)
    error, by_noise = errors_and_noise(simulation, measured, starts, steps, sensor_std, rng)
    if len(error) < HEADLINE_WINDOWS:
        return ()
    usual = np.maximum(np.median(by_noise, axis=0), FAR_NEGLIGIBLE * spread)
    ratio = np.median(error, axis=0) / usual
    worst = int(ratio.argmax())
    beyond = Difference.of_losses(error[:, worst], np.maximum(by_noise[:, worst], usual[worst]))
    if ratio[worst] <= FAR_RATIO or beyond.evidence <= ENOUGH + math.log(len(names)):
        return ()
    missed, noise = (quantity(v, units[worst], 2) for v in (np.median(error[:, worst]), usual[worst]))
    ahead = duration(steps * simulation.control_step)
    return (f"{names[worst]} is wrong by {missed} {ahead} ahead, where the sensors' noise explains {noise}",)


def reasons_against(
    simulation: Simulation, effects: Sequence[Effect], predictions: Predicted | None
) -> tuple[str, ...]:
    """Reasons against putting effects into a simulator for training; empty if there are none."""
    reasons = []
    acting = _acting(effects)
    if predictions is None:
        if acting:
            reasons.append("the rows that chose nothing are too few to tell whether the effects found lower the error")
    elif acting:
        if not predictions.is_better:
            reasons.append("the effects found do not lower the error on data that chose nothing")
    elif learnt := predictions.learnt:
        reasons.append(f"the noise found stands for something that can be predicted: {learnt[0]}")
    return tuple(reasons)


def _acting(effects: Sequence[Effect]) -> list[Effect]:
    """The effects that change the motion; noise does not."""
    return [effect for effect in effects if not effect.random]


def implausible_values(effects: Sequence[Effect], names: EntryNames) -> tuple[str, ...]:
    """The effects with a value that a machine hardly has, in words: each speaks against them if errors are left."""
    return tuple(f"{effect_words(effect, names)} is {why}" for effect in effects if (why := _why_implausible(effect)))


def _why_implausible(effect: Effect) -> str:
    """Why a value is implausible: a factor far from one, or a fit that ended at a bound; empty if it is plausible."""
    for parameter in effect.parameters.values():
        if isinstance(effect, JointRange):
            continue  # a joint may be locked, which is a range of next to nothing
        if parameter.neutral == 1.0:  # a factor; a reversed sensor or motor has -1
            if not 1.0 / EXTREME_FACTOR < abs(parameter.value) < EXTREME_FACTOR:
                return "implausibly far from the model's value"
        elif any(_reached(bound, parameter.value, parameter.neutral) for bound in parameter.bounds):
            return "at the end of what was allowed"
    return ""


def _reached(bound: float, value: float, neutral: float) -> bool:
    """Whether a fitted value lies at a bound; a bound at the neutral value means that there is no effect."""
    tolerance = 1e-3 * abs(bound - neutral) if np.isfinite(neutral) else 0.0
    return bool(np.isfinite(bound) and bound != neutral and abs(value - bound) <= tolerance)


def where_most(simulation: Simulation, measured: Measured) -> str:
    """When, in which quantity and at which states the remaining one-step residual is largest, as a clause."""
    rows = measured.reported_on()
    missed = np.abs(residuals(simulation, measured, rows)[:, 0])
    change = np.maximum((measured.following - measured.observation)[rows].std(0), 1e-12)
    size = np.nan_to_num(missed / change, nan=0.0)
    dimension = int(size.mean(0).argmax())
    blocks = np.array_split(np.arange(len(rows)), BLOCKS)
    block = max(blocks, key=lambda part: size[part, dimension].mean() if len(part) else -1.0)
    ends = rows[block[[0, -1]]]
    begin, end = (number(float(measured.time[row]), 3) for row in ends)
    run = f" (run {' to '.join(map(str, np.unique(measured.run[ends])))})" if measured.run[-1] > 0 else ""
    most = np.argsort(size[:, dimension])[-max(1, round(DESCRIBED_SHARE * len(rows))) :]
    where = where_it_is_large(simulation, measured, rows, size[:, dimension], most)
    return f"most in {simulation.state_map.names[dimension]}, between {begin} and {end} s{run}{where and ',' + where}"
