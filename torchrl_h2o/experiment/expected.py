"""The verdict that an experiment is expected to bring: the loop is closed on logs that the explanations predict."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from scipy.special import ndtr
from tensordict import TensorDict, TensorDictBase

from torchrl_h2o.data.readers.ted import to_ted
from torchrl_h2o.experiment.design import Setting
from torchrl_h2o.experiment.separation import Motion, information_of
from torchrl_h2o.likelihood import Difference
from torchrl_h2o.residuals.ground import Ground
from torchrl_h2o.residuals.grow import ALIKE, advantage
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.report.words import effect_words
from torchrl_h2o.residuals.simulation.simulation import Simulation


@dataclass(frozen=True)
class Narrowing:
    """A value of the likeliest explanation.

    Args:
        words: the effect and its parameter.
        share: expected width of the 95 % interval afterwards, as a share of that before.
    """

    words: str
    share: float


def told_apart(
    setting: Setting,
    log: TensorDictBase,
    knots: np.ndarray,
    rng: np.random.Generator,
    show: Callable[[float], object] = lambda share: None,
) -> np.ndarray:
    """Probability that a true explanation (row) is told from a rival (column) by both logs together, (K, K).

    A log of each explanation is simulated with the sensors' noise, and all explanations are fitted to it and to the
    log at hand, by the score of the search. The evidence of a single log scatters; with a mean of E nats, its standard
    deviation is the root of 2 E (that of a chi-squared statistic).

    Args:
        setting: what the experiment is for.
        log: the transitions at hand, (T,), in TED.
        knots: knots of the commands.
        rng: draws the noise.
        show: called with the share that is done.
    """
    count = len(setting.explanations)
    found = np.ones((count, count))
    for i, truth in enumerate(setting.explanations):
        new = simulated_log(setting, truth.simulation, knots, log, rng)
        measured = Measured.from_ted(joined(new, log), setting.base)
        ground = Ground.of(setting.base, measured, truth.found.effects)
        fitted = [ground.fitted(one.found.entries, one.found.effects) for one in setting.explanations]
        for j in range(count):
            if j != i:
                evidence = Difference(fitted[i].scores - fitted[j].scores).evidence
                nats = min(evidence, advantage(fitted[i], fitted[j]))  # the search leaves a rival open by either
                found[i, j] = ndtr((nats - ALIKE) / math.sqrt(2.0 * max(nats, 1.0)))
        show((i + 1) / count)
    return found


def narrowed(setting: Setting, knots: np.ndarray) -> tuple[Narrowing, ...]:
    """How far the experiment narrows the values of the likeliest explanation."""
    one = setting.explanations[0]
    more = information_of(one, setting.motion(0, knots), setting.yard)
    before, after = (np.sqrt(np.diag(np.linalg.inv(each))) for each in (one.information, one.information + more))
    words = [effect_words(effect, setting.base.names) for effect in one.found.effects]
    return tuple(
        Narrowing(f"{words[variable.effect]} ({variable.name})", float(share))
        for variable, share in zip(one.variables, after / before, strict=True)
    )


def simulated_log(
    setting: Setting, simulation: Simulation, knots: np.ndarray, like: TensorDictBase, rng: np.random.Generator
) -> TensorDict:
    """The log that an explanation predicts, (T,), in TED, with the noise of the sensors.

    Args:
        setting: what the experiment is for.
        simulation: the simulator with the explanation's effects.
        knots: knots of the commands.
        like: the log at hand, whose entries it has.
        rng: draws the noise.
    """
    motion = Motion.of(simulation, setting.rest, setting.commands(knots))
    noise = setting.noise * rng.standard_normal(motion.readings.shape)
    return as_ted(motion.readings + noise, motion.actions, like)


def as_ted(readings: np.ndarray, actions: np.ndarray, like: TensorDictBase | None = None) -> TensorDict:
    """Readings (T + 1, n) and commands (T, nu) as transitions, (T,), of one run.

    Errors of columns that were estimated from others are taken from another log, if one is given.

    Examples:
        >>> import numpy as np
        >>> as_ted(np.zeros((4, 2)), np.zeros((3, 1)))["next", "observation"].shape
        torch.Size([3, 2])
    """
    ends = np.zeros(len(actions), bool)
    ted = to_ted(
        observation=readings[:-1], action=actions, next_observation=readings[1:], terminated=ends, truncated=ends
    )
    if like is not None and "observation_std" in like.keys():
        ted["observation_std"] = like["observation_std"][:1].expand(len(ted), -1).clone()
    return ted


def joined(new: TensorDictBase, old: TensorDictBase) -> TensorDictBase:
    """A new log before the earlier ones, (T,): errors are reported on the end of the data, and fits need the new log.

    Entries that only one of them has, such as the time, are left out.

    Args:
        new: transitions of the new log, (T1,), in TED.
        old: transitions of one or more earlier logs, (T2,), in TED.
    """
    earlier = old["log"] if "log" in old.keys() else torch.zeros(len(old), dtype=torch.int64)
    shared = set(new.keys(True, True)) & set(old.keys(True, True))
    both: Sequence[TensorDictBase] = (
        new.select(*shared).set("log", torch.zeros(len(new), dtype=torch.int64)),
        old.select(*shared).set("log", earlier + 1),
    )
    return cast(TensorDictBase, torch.cat(both))  # typed as a tensor
