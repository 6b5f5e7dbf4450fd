"""Series of machines whose parts scatter, and the worlds of domain randomisation in which policies for them train."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import torch
from robot_cases import EFFECTS as ROBOT
from systems import SYSTEMS
from tensordict import TensorDict
from torchrl.envs import Compose, DoubleToFloat, EnvBase, TransformedEnv

from torchrl_h2o.effects import (
    ActionDelay,
    Effect,
    JointFrictionLoss,
    Payload,
)
from torchrl_h2o.envs import BatchedMujocoEnv, mujoco_model
from torchrl_h2o.residuals import Report
from torchrl_h2o.training.preprocessing import Preprocessing
from torchrl_h2o.training.randomisation import usual_world
from torchrl_h2o.training.returns import Evaluation

World = tuple[Effect, ...]
USUAL = 0.2  # half width of the usual range of domain randomisation, as a share of each number of the model


@dataclass(frozen=True)
class Series:
    """Machines of one kind, each with its own values of what their simulator lacks.

    Args:
        system: a name of :data:`~systems.SYSTEMS`.
        missing: what the simulator lacks, with the mean values of the series. Only the first parameter of each effect
            scatters; further ones say where it acts.
        episode: control steps of an episode of the evaluation.
        score: name and function of what is reported beside the return.
        options: of the training, where they differ from the robot's.
    """

    system: str
    missing: World
    episode: int
    score: tuple[str, Callable[[Evaluation], float]]
    options: tuple[str, ...] = ()

    def machines(self, number: int, scatter: float, *, stream: int) -> list[World]:
        """Draws machines.

        Args:
            number: of machines.
            scatter: standard deviation of each value, as a share of it.
            stream: of the random numbers; two streams share no machine.
        """
        rng = np.random.default_rng(stream)

        def drawn(effect: Effect) -> Effect:
            name, size = next(iter(effect.parameters.items()))
            return effect.with_parameters({name: size.neutral + rng.normal(1.0, scatter) * (size.value - size.neutral)})

        return [tuple(map(drawn, self.missing)) for _ in range(number)]

    def logs(self, machines: Sequence[World], rows: int, noise: float) -> TensorDict:
        """Records a log of each machine, TED ``(machines · rows,)`` with the entry ``log``.

        Args:
            machines: what the simulator lacks for each machine.
            rows: transitions of each log.
            noise: standard deviation of every sensor's noise, as a share of the signal's own.
        """
        logs = []
        for number, machine in enumerate(machines):
            log = SYSTEMS[self.system].record(machine, rows, number, noise=noise)
            logs.append(log.set("log", torch.full((rows,), number)))
        return torch.cat(logs)

    def accepts(self, effects: World) -> bool:
        """Whether the simulator's model can have these effects."""
        try:
            SYSTEMS[self.system].env(effects)
        except ValueError:
            return False
        return True

    def simulator(self) -> EnvBase:
        """Builds the simulator without any of what it lacks."""
        return SYSTEMS[self.system].env(episode=self.episode)

    def env(self, worlds: Sequence[World], preprocessing: Preprocessing) -> EnvBase:
        """Builds simulated worlds, which are stepped together."""
        env = BatchedMujocoEnv(self.simulator(), len(worlds), worlds, num_threads=1)
        return TransformedEnv(env, Compose(DoubleToFloat(), *preprocessing.transforms()))


SERIES: Mapping[str, Series] = MappingProxyType(
    {
        "robot": Series("wheel_legged", ROBOT, 6000, ("seconds stood", lambda found: 0.005 * found.mean_length)),
        "arm": Series(
            "reaching arm",
            (
                JointFrictionLoss(0.4, joints="shoulder"),
                JointFrictionLoss(0.15, joints="elbow"),
                Payload(0.2, z=-0.3, bodies="lower"),
                ActionDelay(0.01),
            ),
            500,
            ("tracking error, mm", lambda found: -1000.0 * found.mean / found.mean_length),
            ("reward_offset=0.0", "reward_scale=1.0", "gamma=0.99"),
        ),
    }
)


def _measured(series: Series, report: Report, machines: Sequence[World], seed: int) -> Sequence[World]:
    # a draw that the model rejects, such as negative friction, is replaced by the best values
    return [w if series.accepts(w) else report.effects for w in report.sample(len(machines), seed=seed)]


def _usual(series: Series, report: Report, machines: Sequence[World], seed: int) -> Sequence[World]:
    model, rng = mujoco_model(series.simulator()), np.random.default_rng(seed)
    return [usual_world(model, rng, USUAL) for _ in machines]


#: the worlds of a training, as many as machines are given, from a series, its report, machines of it and a seed
WORLDS: Mapping[str, Callable[[Series, Report, Sequence[World], int], Sequence[World]]] = MappingProxyType(
    {
        "measured ranges": _measured,
        "± 20 %": _usual,
        "mended": lambda series, report, machines, seed: [report.effects] * len(machines),
        "unmended": lambda series, report, machines, seed: [()] * len(machines),
        "the series itself": lambda series, report, machines, seed: machines,
    }
)
