"""Closes the loop: find the residual, trace it to effects, add them, report. One call, of four that stand alone."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from tqdm import tqdm

from torchrl_h2o.effects import CatalogueEntry
from torchrl_h2o.residuals.judge.summary import DISTURBED, summarise
from torchrl_h2o.residuals.measured.measured import Measured
from torchrl_h2o.residuals.measured.outside import outside_intervals, outside_rows, still_outside
from torchrl_h2o.residuals.measured.residual import residuals
from torchrl_h2o.residuals.report.report import DataSummary, Report
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.undeclared.explanation import explain

_MAY_DIVERGE = 0.1  # of the transitions: a few are measured in a fall, or wrongly


def close_the_loop(
    simulator: EnvBase | Simulation,
    data: TensorDictBase | Measured,
    catalogue: Sequence[CatalogueEntry] | None = None,
    *,
    source: str = "transitions",
    held_out: float = 0.3,
    seed: int = 0,
    progress: bool = True,
) -> Report:
    """What a simulator lacks, by measured data: named, fitted, put in, and judged on data that no fit has seen.

    Args:
        simulator: a TorchRL env of a Gymnasium MuJoCo task, with its gaps, or a :class:`Simulation`.
        data: transitions (T,) in TED, as the readers of :mod:`torchrl_h2o.data` return them, or :class:`Measured`.
        catalogue: the effects to try; those of :meth:`Simulation.catalogue` by default.
        source: what to call the data.
        held_out: share of the transitions, the last ones, that no fit sees.
        seed: of the windows that are screened and of the networks.
        progress: whether to show a progress bar.

    Returns:
        The report; ``DynamicsGap(*report.effects)`` mends the simulator.

    Raises:
        DataError: if the data do not fit the simulator.
        ValueError: if the simulator's state cannot be told from its observations.

    Examples:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from torchrl_h2o.effects import CatalogueEntry, Gravity
        >>> from torchrl_h2o.envs import DynamicsGap
        >>> measured = GymEnv("InvertedPendulum-v5").rollout(600, break_when_any_done=False)
        >>> simulator = TransformedEnv(GymEnv("InvertedPendulum-v5"), DynamicsGap(Gravity(2.0)))
        >>> gravity = CatalogueEntry(Gravity(), ({"scale": 0.8}, {"scale": 1.25}))
        >>> report = close_the_loop(simulator, measured, [gravity], progress=False)
        >>> [effect.describe() for effect in report.effects]
        ['gravity × 0.5']
    """
    start = time.perf_counter()
    simulation = simulator if isinstance(simulator, Simulation) else Simulation.from_env(simulator)
    measured = (
        data if isinstance(data, Measured) else Measured.from_ted(data, simulation, source=source, held_out=held_out)
    )
    if (reason := measured.why_no_conclusion() or _why_it_diverges(simulation, measured)) is not None:
        summary = DataSummary(measured.source, len(measured), int(measured.held_out.sum()), measured.left_out)
        return Report(simulator=simulation.name, data=summary, conclusion=reason)
    entries = simulation.catalogue() if catalogue is None else catalogue
    with tqdm(desc="closing the loop", unit=" effects", disable=not progress) as bar:
        suspected = outside_intervals(simulation, measured)
        calm = measured.without(outside_rows(suspected, len(measured)), DISTURBED)
        explanation = explain(simulation, calm, entries, rng=np.random.default_rng(seed), progress=bar)
        bar.set_description("reporting")
        disturbed = still_outside(suspected, simulation.with_effects(*explanation.effects), measured)
        judged = measured.without(outside_rows(disturbed, len(measured)), DISTURBED)
        return summarise(simulation, judged, explanation, disturbed=disturbed, seed=seed, start=start)


def _why_it_diverges(simulation: Simulation, measured: Measured) -> str | None:
    """Why nothing can be said with a simulator that blows up at measured states, None if it does not."""
    diverged = ~np.isfinite(residuals(simulation, measured, measured.fitted())).all((1, 2))
    if diverged.mean() <= _MAY_DIVERGE:
        return None
    return (
        f"the simulator diverges within one step of {diverged.mean():.0%} of the measured states; check its timestep, "
        "the units, and which coordinate each column is"
    )
