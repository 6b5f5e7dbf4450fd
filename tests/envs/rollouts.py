"""Envs with gaps and repeatable rollouts for the tests."""

import torch
from tensordict import TensorDict
from torchrl.envs import EnvBase, GymEnv, TransformedEnv

from torchrl_h2o.effects import Effect
from torchrl_h2o.envs import DynamicsGap

CHEETAH = "HalfCheetah-v5"


class Executed(GymEnv):
    """An env that records the executed actions."""

    def read_action(self, action):
        self.executed = [*getattr(self, "executed", []), action.clone()]
        return super().read_action(action)


def gapped(*effects: Effect) -> TransformedEnv:
    return TransformedEnv(GymEnv(CHEETAH), DynamicsGap(*effects))


def rollout(env: EnvBase, steps: int = 10, seed: int = 0) -> TensorDict:
    torch.manual_seed(seed)
    env.set_seed(seed)
    return env.rollout(steps, break_when_any_done=False)
