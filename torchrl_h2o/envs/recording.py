"""Records transitions from an env under a policy."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase, InitTracker, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

DONE_KEYS = ("done", "terminated", "truncated")


def record(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    num_transitions: int = 16_588,
    seed: int = 0,
    *,
    progress: bool = True,
) -> TensorDict:
    """Records transitions in temporal order, over as many episodes as needed.

    The last transition is marked as truncated. The policy runs with ``ExplorationType.RANDOM``; ``is_init``
    in its input marks the start of an episode. The same seed gives the same data. The state of torch's global CPU
    generator is restored; generators of other devices are seeded too, and their earlier states are not restored.

    Args:
        env: the env, not batched; it is reset first and stays open.
        policy: a TensorDict module or function that writes ``action``.
        num_transitions: number of transitions; the default is the size of the real robot's log.
        seed: seed of env and policy.
        progress: whether to show a progress bar.

    Returns:
        TensorDict of batch size ``(num_transitions,)`` in TED form: observation, action, done, terminated, truncated,
        and under ``next`` observation, reward, done, terminated, truncated. Numbers are float32 for any precision of
        the env, as in all measured data.

    Raises:
        ValueError: for fewer than one transition, a seed that is no integer, or an env that is batched or has no
            ``observation``.

    Example:
        >>> from torchrl_h2o.envs.wheel_legged.balance_controller import BalanceController
        >>> from torchrl_h2o.envs.wheel_legged.env import WheelLeggedEnv
        >>> data = record(WheelLeggedEnv(), BalanceController(), 50, seed=0, progress=False)
        >>> data["next", "observation"].shape, int(data["next", "done"].sum())
        (torch.Size([50, 4]), 1)
    """
    if num_transitions < 1:
        raise ValueError(f"num_transitions is {num_transitions}; record at least one")
    if not isinstance(seed, int):
        raise ValueError(f"seed is {seed!r}; give an integer")
    if env.batch_size:
        raise ValueError(
            f"record takes one env, not a batch of {tuple(env.batch_size)}; record from each of its envs and "
            "concatenate the results"
        )
    if "observation" not in env.observation_spec.keys():
        raise ValueError(
            f"{env} has no 'observation', but {', '.join(map(str, env.observation_spec.keys()))}; concatenate these: "
            "env.append_transform(CatTensors([...], out_key='observation'))"
        )
    # auto_unwrap=False, because TorchRL would otherwise warn and work on clones of the env's transforms
    tracked = TransformedEnv(env, InitTracker(), auto_unwrap=False)
    keys = ["observation", "action", *DONE_KEYS, ("next", "observation"), ("next", "reward")]
    keys += [("next", key) for key in DONE_KEYS]
    transitions = []
    with (
        torch.random.fork_rng(devices=[]),
        torch.no_grad(),
        set_exploration_type(ExplorationType.RANDOM),
    ):
        torch.manual_seed(seed)
        tracked.set_seed(seed)
        state = tracked.reset()
        for _ in tqdm(range(num_transitions), "recording", unit="step", disable=not progress):
            transition, state = tracked.step_and_maybe_reset(policy(state))
            transitions.append(transition.select(*keys))
    recording = cast("TensorDict", torch.stack(transitions))
    recording["next", "truncated"][-1] |= ~recording["next", "terminated"][-1]
    recording["next", "done"][-1] = True
    for key in ("observation", "action", ("next", "observation"), ("next", "reward")):
        recording[key] = recording[key].float()
    return recording
