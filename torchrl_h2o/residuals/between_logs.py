"""Values in each of several logs: which logs contain a value, whether they agree, and how far it scatters."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2, norm

IDENTIFIABLE, WEAK, NOT_IDENTIFIABLE = "identifiable", "weak", "not identifiable"
LEVEL = 0.05  # p-value above which logs agree
_WEAK = 0.5  # standard error, as a share of a value's distance from neutral, above which a log hardly contains it
_QUANTILES = (np.arange(200) + 0.5) / 200  # of the distributions of a variance and of a value
_VARIANCES = np.geomspace(1e-6, 1e6, 400)  # between logs, in squared ranges or largest squared errors of the values


@dataclass(frozen=True)
class InLogs:
    """A fitted value in each of several logs, by this log alone.

    Args:
        logs: indices of the logs.
        values: the value in each log, linearised about the fit to all of them.
        errors: standard error of each; infinite for a log that does not contain the value.
        size: distance of the value in all logs from neutral, or from 0 if it has no finite neutral value.

    Examples:
        >>> friction = InLogs((0, 1, 2), (0.2, 0.4, 0.3), (0.01, 0.02, math.inf), size=0.3)
        >>> friction.kinds, friction.agree, friction.range
        (('identifiable', 'identifiable', 'not identifiable'), False, (0.2, 0.4))
    """

    logs: tuple[int, ...]
    values: tuple[float, ...]
    errors: tuple[float, ...]
    size: float

    @property
    def kinds(self) -> tuple[str, ...]:
        """Whether each log contains the value: identifiable, weak or not identifiable."""
        return tuple(
            NOT_IDENTIFIABLE if math.isinf(error) else WEAK if error > _WEAK * self.size else IDENTIFIABLE
            for error in self.errors
        )

    @property
    def p_value(self) -> float | None:
        """p-value of equal values in all logs, see :func:`p_values`; None if fewer than two logs contain the value."""
        found = float(p_values(np.array(self.values)[:, None], np.array(self.errors)[:, None] ** 2)[0])
        return None if math.isnan(found) else found

    @property
    def agree(self) -> bool | None:
        """Whether the logs agree; None if fewer than two contain the value."""
        return None if self.p_value is None else self.p_value > LEVEL

    @property
    def range(self) -> tuple[float, float]:
        """Lowest and highest value of the logs in which it is identifiable, or else of all that contain it."""
        for kinds in ((IDENTIFIABLE,), (IDENTIFIABLE, WEAK)):
            values = [value for value, kind in zip(self.values, self.kinds, strict=True) if kind in kinds]
            if len(values) > 1:
                return min(values), max(values)
        return math.nan, math.nan


def p_values(values: np.ndarray, variances: np.ndarray) -> np.ndarray:
    """p-values of equal values in all logs by Cochran's Q, (p,); NaN for a value that fewer than two logs contain.

    W. G. Cochran, *The combination of estimates from different experiments*, Biometrics 10 (1954), 101-129.

    Args:
        values: the values in each log, (logs, p).
        variances: squared standard errors of these, (logs, p); infinite for a log that does not contain the value.

    Examples:
        >>> import numpy as np
        >>> p_values(np.array([[1.0, 1.0], [1.1, 2.0]]), np.array([[0.01, 0.01], [0.01, np.inf]])).round(2).tolist()
        [0.48, nan]
    """
    q, logs = _weighted(values, variances)[2], np.isfinite(variances).sum(0)
    return np.where(logs > 1, chi2.sf(q, np.maximum(logs - 1, 1)), np.nan)


def half_widths_between(values: np.ndarray, variances: np.ndarray) -> np.ndarray:
    """Half-widths of the 95 % intervals by which the value in another log differs from the mean of these, (p,).

    Few logs tell little of the variance between logs: even where they agree, it may be as large as their errors allow.
    Each variance counts as often as its confidence distribution says, by which Cochran's Q with this variance added is
    chi-squared. 0 for a value that fewer than two logs contain.

    K. Nagashima, H. Noma and T. A. Furukawa, *Prediction interval for random-effects meta-analysis: a confidence
    distribution approach*, Statistical Methods in Medical Research 28 (2019), 1689-1702; W. Viechtbauer, *Confidence
    intervals for the amount of heterogeneity in meta-analysis*, Statistics in Medicine 26 (2007), 37-52.

    Args:
        values: the values in each log, (logs, p).
        variances: squared standard errors of these, (logs, p); infinite for a log that does not contain the value.

    Examples:
        >>> import numpy as np
        >>> errors = np.full((3, 2), 0.01)
        >>> half_widths_between(np.array([[1.0, 0.0], [2.0, 0.1], [3.0, -0.1]]), errors).round(1).tolist()
        [5.0, 0.5]
    """
    weight, total, _ = _weighted(values, variances)
    of_mean = ((weight / total) ** 2).sum(0)
    found = np.zeros(values.shape[1])
    for index in np.flatnonzero(np.isfinite(variances).sum(0) > 1):
        known = np.isfinite(variances[:, index])
        value, variance = values[known, index][:, None], variances[known, index][:, None]
        between = _VARIANCES * max(variance.max(), np.ptp(value) ** 2)
        at_most = chi2.sf(_weighted(value, variance + between)[2], len(value) - 1)
        scatter = np.sqrt(np.interp(_QUANTILES, at_most, between, left=0.0))
        found[index] = np.quantile(np.outer(scatter, norm.isf(0.5 * _QUANTILES)), 0.95)
    return found * np.sqrt(1.0 + of_mean)


def _weighted(values: np.ndarray, variances: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inverse variances, (logs, p), their sum, (p,), and Cochran's Q, (p,)."""
    weight = 1.0 / np.maximum(variances, 1e-100)
    total = np.maximum(weight.sum(0), 1e-300)
    mean = (weight * values).sum(0) / total
    return weight, total, (weight * (values - mean) ** 2).sum(0)
