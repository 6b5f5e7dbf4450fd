"""Two-sample test of the dynamics gap: held-out AUC of a classifier of measured against simulated transitions."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import torch
from scipy.stats import mannwhitneyu
from tensordict import TensorDict

from torchrl_h2o.objectives import DynamicsRatioLoss, make_dynamics_ratio_estimator
from torchrl_h2o.residuals.measured.residual import residuals, start_states
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.settings import DEFAULTS, LoopSettings
from torchrl_h2o.residuals.simulation.simulation import Simulation

CLASSIFIER_BATCH = 256  # transitions in an update of the discriminators
CLASSIFIER_CELLS = (64, 64)  # hidden layers of the discriminators


def two_sample_auc(
    simulation: Simulation,
    measured: Measured,
    *,
    sensor_std: np.ndarray | None = None,
    seed: int = 0,
    settings: LoopSettings = DEFAULTS,
) -> float:
    """Measures how well a classifier separates measured from simulated next observations of the same state and action.

    The discriminators of Eq. (9) are trained on the fitted part, and their log dynamics ratio is evaluated on the
    held-out part. Their input is the change of the observation, each dimension in units of its spread.

    Args:
        simulation: the simulator.
        measured: the data.
        sensor_std: (n), standard deviation of the readings' noise, which is then added to the simulated outcomes and
            their start states.
        seed: seed of the networks and the batches.
        settings: number of updates.

    Returns:
        Area under the ROC curve: 0.5 if the gap is undetectable, 1 if every transition is classified correctly.

    Source: H2O+ (Niu et al., 2023, arXiv 2309.12716), Eq. (9).
    """
    fitted, judged = measured.fitted(), measured.reported_on()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        train = _real_and_simulated(simulation, measured, fitted, fitted, sensor_std)
        test = _real_and_simulated(simulation, measured, judged, fitted, sensor_std)
        estimator = make_dynamics_ratio_estimator(
            measured.observation.shape[1],
            measured.action.shape[1],
            CLASSIFIER_CELLS,
            logit_bound=None,
            clamp=None,
        )
        loss = DynamicsRatioLoss(estimator)
        optimiser = torch.optim.AdamW(loss.parameters(), lr=1e-3, weight_decay=1e-2, fused=True)
        for _ in range(settings.classifier_updates):
            simulation.check()
            losses = loss(train[torch.randint(len(train), (CLASSIFIER_BATCH,))])
            optimiser.zero_grad()
            (losses["loss_ratio_sa"] + losses["loss_ratio_sas"]).backward()
            optimiser.step()
        with torch.no_grad():
            score = estimator.eval()(test)["log_dynamics_ratio"]
    real, score = cast("torch.Tensor", test["real"]).numpy(), score.numpy()
    larger = mannwhitneyu(score[real], score[~real]).statistic  # pairs in which the measured one has the larger ratio
    return float(larger / (real.sum() * (~real).sum()))


def _real_and_simulated(
    simulation: Simulation, measured: Measured, rows: np.ndarray, like: np.ndarray, sensor_std: np.ndarray | None
) -> TensorDict:
    """Measured and simulated transitions of the same states and actions, standardised by the rows ``like``."""
    rng, states = np.random.default_rng(len(rows)), start_states(simulation, measured, rows)
    noise = np.zeros((2, *measured.observation.shape))
    if sensor_std is not None:
        noise = sensor_std * rng.standard_normal(noise.shape)
        states = states + noise[0] @ simulation.state_map.restore_observed.T
    missed = residuals(simulation, measured, rows, states=states, rng=rng)[:, 0] - noise[1][rows]
    whole = np.isfinite(missed).all(1)
    rows, missed = rows[whole], missed[whole]
    change = measured.following - measured.observation

    def standardised(values: np.ndarray, all_values: np.ndarray) -> torch.Tensor:
        mean, std = all_values[like].mean(0), all_values[like].std(0)
        return torch.from_numpy((values - mean) / np.maximum(std, 1e-9)).float()

    observation = standardised(measured.observation[rows], measured.observation)
    action = standardised(measured.action[rows], measured.action)
    parts: list[Any] = [  # torch.cat is annotated for tensors alone
        TensorDict(
            {
                "observation": observation,
                "action": action,
                "next": {"observation": standardised(outcome, change)},
                "real": torch.full((len(rows),), real),
            },
            batch_size=[len(rows)],
        )
        for outcome, real in ((change[rows], True), (change[rows] - missed, False))
    ]
    return cast("TensorDict", torch.cat(parts))
