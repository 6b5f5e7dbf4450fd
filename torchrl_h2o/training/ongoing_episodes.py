"""The simulator's current episodes, which go on from epoch to epoch and are part of a checkpoint."""

from typing import Any, cast

from tensordict import TensorDict
from torchrl.collectors import BaseCollector
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_h2o.envs import BatchedMujocoEnv


def saves_episodes(simulator: EnvBase) -> bool:
    """Whether the current episodes of an environment can be saved: those of a :class:`BatchedMujocoEnv` can."""
    return isinstance(getattr(simulator, "base_env", None), BatchedMujocoEnv)


class OngoingEpisodes:
    """Saves and restores the episodes in which a collector is, so that a resumed run goes on with them.

    The state is empty for collectors that begin new episodes in every batch: those of worker processes, and those of
    environments that cannot save their episodes.

    Args:
        collector: TorchRL's collector.
    """

    def __init__(self, collector: BaseCollector) -> None:
        self._collector = collector
        self._env = cast("TransformedEnv | None", getattr(collector, "env", None))  # None with worker processes
        self._goes_on = self._env is not None and saves_episodes(self._env)

    def begin_epoch(self, epoch: int, seed: int) -> None:
        """Seeds the simulator.

        Args:
            epoch: number of the epoch. In epoch 0 new episodes begin, so that a run depends on its own seed only.
            seed: seed of the epoch.
        """
        self._collector.set_seed(seed % 2**31)
        if epoch == 0 and self._goes_on:
            cast(Any, self._collector).reset()

    def state_dict(self) -> dict[str, Any]:
        """Returns the state of the simulator and its transforms, and the observation that the policy reads next."""
        if not self._goes_on:
            return {}
        env = cast(TransformedEnv, self._env)
        # TorchRL's collectors do not save the state of an env. They hold the current step in _carrier.
        current = cast(Any, self._collector)._carrier.exclude("collector").flatten_keys()
        return {
            "simulator": cast(BatchedMujocoEnv, env.base_env).episodes_state(),
            "transforms": {key: value.clone() for key, value in env.transform.state_dict().items()},
            "current": {key: value.clone() for key, value in current.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        if not self._goes_on:
            return
        env = cast(TransformedEnv, self._env)
        cast(BatchedMujocoEnv, env.base_env).restore_episodes(state["simulator"])
        env.transform.load_state_dict(state["transforms"])
        current = TensorDict(state["current"], env.batch_size).unflatten_keys()
        cast(Any, self._collector)._carrier.update(current)
