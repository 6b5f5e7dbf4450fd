"""What no gains, friction and constant forces explain of a log."""

from __future__ import annotations

import numpy as np

from torchrl_h2o.data.audit.actions import friction_responses
from torchrl_h2o.data.audit.regression import robust_fit
from torchrl_h2o.data.audit.response import Response
from torchrl_h2o.data.audit.settings import AuditSettings


def unexplained(response: Response, settings: AuditSettings, windows: np.ndarray | None = None) -> float:
    """Usual share of the accelerations that no gains, friction, constant forces and small shifts of zeros explain.

    Args:
        response: simulated windows, to all of which these are fitted.
        settings: thresholds.
        windows: mask (W,) of those whose usual share is meant; None for all.
    """
    return _left(response, settings, windows)[0]


def unexplained_and_reversed(response: Response, settings: AuditSettings) -> tuple[float, int]:
    """The same share in all windows, and the number of actions whose fitted gain is negative."""
    return _left(response, settings, None)


def _left(response: Response, settings: AuditSettings, windows: np.ndarray | None) -> tuple[float, int]:
    responses = np.concatenate([response.by_gain, friction_responses(response), response.by_zero], -1)
    found = robust_fit(response.target, responses, response.scale, settings.robust)
    left = np.abs(response.target - responses @ found.values)
    share = np.nanmedian(left if windows is None else left[windows], axis=0) / response.scale
    return float(np.mean(share)), int((found.values[: response.by_gain.shape[-1]] < 0.0).sum())


def percent(share: float) -> str:
    """A share in words."""
    return "all" if share >= 0.995 else f"{share:.0%}"
