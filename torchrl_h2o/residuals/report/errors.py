"""The errors that a report gives: one step and several steps ahead, before and after the effects are put in."""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class DimensionError:
    """Held-out one-step error of one dimension.

    Args:
        name: name of the dimension.
        unit: unit of the errors.
        before: error without the effects.
        after: error with all of them.
        floor: estimated error of the best possible model; None if there is no estimate.
        autocorrelation: rank correlation of successive remaining residuals: about 0 for white residuals, down to
            -0.5 for sensor noise alone, above 0 if the simulator still lacks an effect; None if not computed.
    """

    name: str
    unit: str
    before: float
    after: float
    floor: float | None = None
    autocorrelation: float | None = None


@dataclass(frozen=True)
class HorizonError:
    """Held-out error some control steps ahead, of each dimension by name, in the dimension's unit."""

    steps: int
    seconds: float
    before: Mapping[str, float]
    after: Mapping[str, float]


@dataclass(frozen=True)
class HeadlineError:
    """Median absolute error of one quantity some time ahead, on held-out data: the figure of the report's sentence.

    Args:
        name: name of the quantity.
        unit: its unit.
        seconds: how far ahead, in s.
        before: error without the effects, in the unit.
        after: error with all of them.
    """

    name: str
    unit: str
    seconds: float
    before: float
    after: float


@dataclass(frozen=True)
class ErrorSummary:
    """Held-out error before and after the effects are put in.

    Args:
        metric: name of the error, such as "held-out one-step RMSE, each dimension divided by its spread".
        unit: unit of ``before``, ``after`` and ``floor``, ``"1"`` for a pure number.
        before: error without the effects.
        after: error with all of them.
        floor: estimated error of the best possible model; None if there is no estimate.
        per_dimension: errors of each dimension.
        horizons: errors several steps ahead.
        headline: error of the quantity that the sentence names; None in reports of earlier versions.
    """

    metric: str
    unit: str
    before: float
    after: float
    floor: float | None = None
    per_dimension: tuple[DimensionError, ...] = ()
    horizons: tuple[HorizonError, ...] = ()
    headline: HeadlineError | None = None


@dataclass(frozen=True)
class Prediction:
    """Mean absolute error in spreads of the readings, with its 95 % interval."""

    error: float
    low: float
    high: float


@dataclass(frozen=True)
class PredictedRow:
    """How well the motion of one joint, or all of it, is predicted.

    Args:
        name: ``"total"``, or name of the joint.
        as_it_is: by the simulator without the effects.
        mended: by the simulator with them.
        velocities_stay: by the guess that every velocity stays as it is.
        mended_and_network: by the simulator with the effects and a small network, trained on what it leaves.
    """

    name: str
    as_it_is: Prediction
    mended: Prediction
    velocities_stay: Prediction
    mended_and_network: Prediction


@dataclass(frozen=True)
class PredictionTable:
    """How well held-out motion is predicted some time ahead; the intervals hold the scatter between blocks of rows.

    Args:
        seconds: how far ahead, in s.
        rows: in total, and by joint.
    """

    seconds: float
    rows: tuple[PredictedRow, ...]
