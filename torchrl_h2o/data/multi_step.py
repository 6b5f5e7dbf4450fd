"""n-step transitions for off-policy targets: TorchRL's ``MultiStepTransform``, with the one-step next state kept."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torchrl.envs import MultiStepTransform

STEPS = "steps_to_next_obs"
_NOT_STATES = ("reward", "done", "terminated", "truncated")


def multi_step_keys(keys: Sequence[NestedKey]) -> list[NestedKey]:
    """Return the entries of n-step rows that have the given entries with one step.

    Examples:
        >>> multi_step_keys(["action", ("next", "observation"), ("next", "reward")])[3:]
        [('next', 'original_observation'), 'steps_to_next_obs']
    """
    return [*keys, *(original_key(key) for key in keys if _is_next_state(key)), STEPS]


def original_key(key: NestedKey) -> NestedKey:
    """Name the entry that holds the one-step value of a next state, after TorchRL's ``original_reward``.

    Examples:
        >>> original_key(("next", "observation"))
        ('next', 'original_observation')
    """
    *path, name = (key,) if isinstance(key, str) else key
    return unravel_key((*path, f"original_{name}"))


def with_next_actions(rows: TensorDictBase) -> TensorDictBase:
    """Add the action that follows in the data, ``("next", "action")``; leave out rows after which there is none.

    A terminated row keeps its own action there, because no target reads the action after it.

    Args:
        rows: transitions in time order, ``[T]``; with ``steps_to_next_obs``, the action is that many steps later.

    Returns:
        The rows ``[T']`` that are terminated, or neither end a run nor are the last ones of the data.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> ends = torch.tensor([[False], [True], [False], [False]])
        >>> rows = TensorDict(action=torch.arange(4.0)[:, None], batch_size=4,
        ...                   next=TensorDict(done=ends, terminated=ends & False, batch_size=4))
        >>> with_next_actions(rows)["next", "action"].flatten().tolist()
        [1.0, 3.0]
    """
    place = torch.arange(len(rows), device=rows.device)
    steps = rows.get(STEPS, None)
    later = place + (1 if steps is None else cast(torch.Tensor, steps).flatten())
    done, terminated = (cast(torch.Tensor, rows.get(("next", key))).flatten() for key in ("done", "terminated"))
    known = ~done & (later < len(rows))
    action = cast(torch.Tensor, rows.get("action"))
    extended = rows.copy().set(("next", "action"), action[torch.where(known, later, place)])
    return cast(TensorDictBase, extended[known | terminated])


def _is_next_state(key: NestedKey) -> bool:
    return not isinstance(key, str) and key[0] == "next" and key[-1] not in _NOT_STATES


class OngoingMultiStep(MultiStepTransform):
    r"""``MultiStepTransform`` for streams of transitions in time order, whose waiting rows can be saved.

    A row (s, a, r, s') becomes the n-step row with the reward :math:`\sum_{k<m}\gamma^k r_{t+k}`, the next state and
    the end marks of step t + m - 1, and ``steps_to_next_obs`` = m. m is n, or less where the episode or the run of the
    data ends before. The one-step next state stays, as ``("next", "original_observation")``; discriminators read it.

    Differences from TorchRL's class:

    - ``terminated`` is that of the state reached after m steps. With TorchRL's default it stays that of the first step,
      and a target bootstraps from terminated states.
    - The last n rows of a stream wait for their successors; :meth:`whole` completes them for data that have an end.

    Args:
        n_steps (int): n, at least 1.
        gamma (float): discount factor γ.

    Raises:
        ValueError: if ``n_steps`` is not a positive integer.

    Examples:
        >>> import torch
        >>> from torchrl.envs import GymEnv
        >>> data = GymEnv("Pendulum-v1").rollout(5)
        >>> OngoingMultiStep(3, gamma=0.9).whole(data)["steps_to_next_obs"].flatten().tolist()
        [3, 3, 3, 2, 1]
    """

    def __init__(self, n_steps: int, gamma: float) -> None:
        # No done_keys: they would keep the values of the first step.
        super().__init__(n_steps, gamma, done_keys=[])

    def transform(self, transitions: TensorDictBase) -> TensorDictBase | None:
        """Append transitions to the stream and return the rows that have all their successors.

        Args:
            transitions: the stream's next part, ``[*B, T]``, with the same B in each call.

        Returns:
            n-step rows ``[*B, T]``, at the first call ``[*B, T - n]``; None if there are none yet.
        """
        rows = cast("TensorDictBase | None", self.inv(self._with_one_step(transitions)))
        if rows is None:
            return None
        one_step = cast(TensorDictBase, rows.pop("kept"))
        for key in one_step.keys(True, True):
            rows.set(original_key(key), one_step.get(key))
        return rows.set(STEPS, rows.get(STEPS).reshape(*rows.batch_size, 1))

    @staticmethod
    def _with_one_step(transitions: TensorDictBase) -> TensorDictBase:
        """Add a copy of the next states outside of ``"next"``, where TorchRL does not replace them."""
        states = [key for key in transitions.keys(True, True) if _is_next_state(key)]
        return transitions.copy().set("kept", transitions.select(*states))

    def whole(self, transitions: TensorDictBase) -> TensorDictBase:
        """Return the n-step rows of complete data ``[T]``; the last row counts as the end of a run."""
        ended = transitions.copy()
        ended["next"] = cast(TensorDictBase, ended["next"]).copy()
        done = ended["next", "done"].clone()
        done[-1] = True
        ended["next", "done"] = done
        # The rows after the end only complete the windows; the end mark keeps them out of every sum.
        after = cast(TensorDictBase, ended[:1].expand(self.n_steps))
        fresh = OngoingMultiStep(self.n_steps, self.gamma)
        rows = fresh.transform(cast(TensorDictBase, torch.cat([ended, after])))
        return cast(TensorDictBase, rows)

    @property
    def waiting(self) -> TensorDictBase | None:
        """The rows that wait for their successors, ``[*B, n]`` or fewer; None before the first call. Can be set."""
        rows = cast("TensorDictBase | None", self._buffer)
        return None if rows is None else rows.exclude("kept")

    @waiting.setter
    def waiting(self, rows: TensorDictBase | None) -> None:
        self._buffer = None if rows is None else self._with_one_step(rows)
