"""Closes the loop: finds what a simulator lacks from measured data, puts it in, and reports the held-out error.

Each stage takes the results of earlier stages and returns a new one; no stage changes another's result.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from torchrl_h2o.data.audit import Audit
from torchrl_h2o.effects import CatalogueEntry, Effect
from torchrl_h2o.provenance import cpu_seconds, provenance
from torchrl_h2o.residuals.action_noise import add_action_noise
from torchrl_h2o.residuals.compose_report import compose_report, inconclusive_report, unfinished_report
from torchrl_h2o.residuals.evidence import Evidence, gather_evidence, why_no_conclusion
from torchrl_h2o.residuals.explanation import Explanation
from torchrl_h2o.residuals.judge.judgement import judge
from torchrl_h2o.residuals.measured.transitions import HELD_OUT, Measured
from torchrl_h2o.residuals.offered import late_velocities, offered_entries
from torchrl_h2o.residuals.progress import NOISE, REPORT, LoopBar, OutOfTimeError
from torchrl_h2o.residuals.report.document import Report
from torchrl_h2o.residuals.search import search
from torchrl_h2o.residuals.simulation.simulation import Simulation

FAILURES = (ValueError, np.linalg.LinAlgError)  # a model that rejects an effect, or singular equations


def close_the_loop(
    simulator: EnvBase | Simulation,
    data: TensorDictBase | Measured,
    catalogue: Sequence[CatalogueEntry] | None = None,
    *,
    source: str = "transitions",
    held_out: float | Collection[int] = HELD_OUT,
    seed: int = 0,
    progress: bool = True,
    minutes: float | None = None,
    audit: Audit | None = None,
    known: Sequence[Effect] = (),
    so_far: Callable[[Report], object] = lambda report: None,
) -> Report:
    """Finds what a simulator lacks from measured data, and judges it on data that neither a fit nor a choice has used.

    Args:
        simulator: a TorchRL env of a Gymnasium MuJoCo task, with its gaps, or a :class:`Simulation`.
        data: transitions (T,) in TED, as the readers of :mod:`torchrl_h2o.data` return them, or :class:`Measured`.
        catalogue: effects to try; by default those of :meth:`Simulation.catalogue`, but a delay of
            the velocities is read off the data.
        source: name of the data in the report.
        held_out: share of the transitions, taken from the end, on which errors are reported, or the indices of the
            logs on which they are, where the data have the entry ``"log"``; see :meth:`Measured.from_ted`.
        seed: seed of the network that learns from what the effects leave.
        progress: whether to show a progress bar.
        minutes: time for all of it, more than 0: the search ends early enough for its result to be fitted and judged,
            and what could not be judged in time is named in the report. None for as long as it takes.
        audit: findings of :func:`torchrl_h2o.data.audit`, for the report.
        known: effects from which the search begins, such as ``Report.load(folder).effects`` of an unfinished run.
        so_far: called with an unfinished report whenever an effect has been found and after each stage.

    Returns:
        The report; ``DynamicsGap(*report.effects)`` mends the simulator.

    Raises:
        DataError: if the data do not fit the simulator.
        ValueError: for an argument of another type or outside its bounds, or if the simulator's state cannot be
            computed from its observations.

    Examples:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from torchrl_h2o.effects import CatalogueEntry, Gravity
        >>> from torchrl_h2o.envs import DynamicsGap
        >>> measured = GymEnv("InvertedPendulum-v5").rollout(300, break_when_any_done=False)
        >>> simulator = TransformedEnv(GymEnv("InvertedPendulum-v5"), DynamicsGap(Gravity(2.0)))
        >>> gravity = CatalogueEntry(Gravity(), ({"scale": 0.8}, {"scale": 1.25}))
        >>> report = close_the_loop(simulator, measured, [gravity], progress=False)
        >>> [effect.describe() for effect in report.effects]
        ['gravity × 0.5']
    """
    start, cpu_start = time.perf_counter(), cpu_seconds()
    _require_arguments(data, catalogue, held_out, seed, known)
    with LoopBar(disable=not progress, minutes=minutes) as bar:
        simulation = simulator if isinstance(simulator, Simulation) else Simulation.from_env(simulator)
        simulation = replace(simulation, check=bar.check)
        measured = read_measured(data, simulation, source, held_out)
        begin = time.perf_counter()
        try:
            if (reason := why_no_conclusion(simulation, measured)) is not None:
                return inconclusive_report(simulation, measured, reason, audit)
            bar.keep_for_report(time.perf_counter() - begin)
            entries = offered_entries(simulation) if catalogue is None else catalogue
            evidence = gather_evidence(simulation, measured, audit=audit)
            explanation = explain(
                evidence,
                entries,
                progress=bar,
                known=known,
                so_far=lambda found, stage: so_far(unfinished_report(evidence, found, stage)),
                late=catalogue is None,
            )
        except OutOfTimeError as end:
            reason = f"the time was up while {end}, before there was a first result; give more minutes"
            return inconclusive_report(simulation, measured, reason, audit)
        so_far(unfinished_report(evidence, explanation, "the errors before and after were computed"))
        bar.stage(REPORT)
        judgement = judge(evidence, explanation, entries, seed=seed, progress=bar)
        bar.finish()
        wall_s = time.perf_counter() - start
        made_by = provenance(cpu_start)
        return compose_report(evidence, explanation, judgement, wall_s=wall_s, made_by=made_by)


def _require_arguments(
    data: object, catalogue: object, held_out: float | Collection[int], seed: object, known: object
) -> None:
    """Raises a ValueError that names the first argument that cannot be used."""
    share = held_out if isinstance(held_out, int | float) else 0.5
    for right, name, value, allowed in (
        (isinstance(data, TensorDictBase | Measured), "data", type(data), "a TensorDict of transitions, or Measured"),
        (_are(catalogue, CatalogueEntry) or catalogue is None, "catalogue", catalogue, "a list of CatalogueEntry"),
        (_are(known, Effect), "known", known, "a list of effects, such as [Gravity(0.9)]"),
        (isinstance(seed, int | np.integer) and seed >= 0, "seed", seed, "a whole number, 0 or more"),
        (0.0 < share < 1.0, "held_out", held_out, "a share above 0 and below 1, or the indices of logs"),
    ):
        if not right:
            raise ValueError(f"{name}={value!r}: must be {allowed}")


def _are(values: object, kind: type) -> bool:
    return isinstance(values, Sequence) and all(isinstance(value, kind) for value in values)


def read_measured(
    data: TensorDictBase | Measured,
    simulation: Simulation,
    source: str,
    held_out: float | Collection[int],
) -> Measured:
    """Measured transitions, checked against the simulation."""
    if isinstance(data, Measured):
        return data
    return Measured.from_ted(data, simulation, source=source, held_out=held_out)


def explain(
    evidence: Evidence,
    catalogue: Sequence[CatalogueEntry],
    *,
    progress: LoopBar,
    known: Sequence[Effect] = (),
    so_far: Callable[[Explanation, str], object] = lambda explanation, stage: None,
    late: bool = False,
) -> Explanation:
    """Explains the residual: effects of the catalogue and forces outside it, then action noise.

    Args:
        evidence: the simulator and the data.
        catalogue: effects that the simulator may lack.
        progress: bar that shows how far the search is, and its stage.
        known: effects from which the search begins.
        so_far: called with a preliminary explanation, as it grows, and the current stage.
        late: whether to read off the data how late velocities are against their positions.

    Returns:
        The explanation, without any parts if nothing is missing; the one so far if the time of ``progress`` is up.
    """
    simulation, measured = evidence.simulation, evidence.undisturbed
    delay, measured = late_velocities(simulation, measured) if late else (None, measured)
    explanations: list[Explanation] = []

    def better(explanation: Explanation) -> None:
        explanations.append(explanation)
        so_far(explanation if delay is None else explanation.beside(delay), "effects were tried")

    try:
        found = search(simulation, measured, catalogue, progress=progress, known=known, so_far=better)
    except FAILURES as error:
        if not explanations:  # the data cannot be searched at all
            raise
        found = explanations[-1].with_failure(f"the search for further effects failed: {error}")
    if delay is not None:
        found = found.beside(delay)
    if found.ended_in is not None or progress.time_is_up:
        return replace(found, ended_in=found.ended_in or NOISE)
    progress.stage(NOISE)
    so_far(found, "action noise was looked for")
    try:
        return add_action_noise(simulation, measured, found)
    except OutOfTimeError:
        return replace(found, ended_in=NOISE)
    except FAILURES as error:
        return found.with_failure(f"the search for action noise failed: {error}")
