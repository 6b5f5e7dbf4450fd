"""Check recorded transitions against the specs of an environment."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase
from torchrl import torchrl_logger

from torchrl_h2o.data.readers.error import DataError
from torchrl_h2o.data.readers.ted import require_ted

if TYPE_CHECKING:
    from torchrl.data import TensorSpec
    from torchrl.envs import EnvBase

# share of an action bound by which an action may exceed it: a recording in float64 that is rounded to float32 exceeds
# it by about 1e-7
BOUND_ROUNDING = 1e-6


def check_specs(td: TensorDictBase, env: EnvBase, *, source: str | Path = "transitions") -> None:
    """Check that transitions match the specs of an environment.

    Args:
        td: flat TED transitions of batch size [T].
        env: a TorchRL environment with the entries ``observation`` and ``action``.
        source: name of the data in errors.

    Raises:
        DataError: for a different number of dimensions, a different kind of number, or an action outside the
            environment's bounds; with the column and the row, counted from 1.

    Example:
        >>> from torchrl.envs import GymEnv
        >>> from torchrl_h2o.data import check_specs
        >>> env = GymEnv("Pendulum-v1")
        >>> td = env.rollout(3)
        >>> check_specs(td, env)
        >>> td["action"][1] = 7.0
        >>> check_specs(td, env)
        Traceback (most recent call last):
        ...
        torchrl_h2o.data.readers.error.DataError: transitions, column 'action[0]', row 2: 7.0 lies outside
        the environment's bounds [-2.0, 2.0]; ...
    """
    require_ted(td, source=source)
    specs = {
        "observation": env.observation_spec_unbatched,
        "action": env.full_action_spec_unbatched,
    }
    for key, composite in specs.items():
        names = list(composite.keys())
        if key not in names:
            problem = f"the environment has no entry {key!r}, it has {names}"
            remedy = "wrap it in TransformedEnv with CatTensors or RenameTransform"
            raise DataError(problem, remedy, source=source, column=key)
        spec, values, problem = composite[key], td[key], None
        if values.shape[1:] != spec.shape:
            problem = f"the data have {list(values.shape[1:])} dimensions, the environment has {list(spec.shape)}"
        elif values.is_floating_point() != spec.dtype.is_floating_point:
            problem = f"the data are {values.dtype}, the environment uses {spec.dtype}"
        if problem is not None:
            remedy = "choose the environment that was recorded, or other columns"
            raise DataError(problem, remedy, source=source, column=key)
    _require_bounds(td["action"], specs["action"]["action"], source)


def warn_of_unknown_task(task: str | None, source: str | Path) -> None:
    """Log a warning that the task of the data is unknown and was not compared with the requested one.

    Args:
        task: the requested task; without one no warning is logged.
        source: name of the data.
    """
    if task is not None:
        torchrl_logger.warning(
            f"{source} does not name the task it was recorded in; whether it is {task} was not checked"
        )


def _require_bounds(action: torch.Tensor, spec: TensorSpec, source: str | Path) -> None:
    low, high = getattr(spec.space, "low", None), getattr(spec.space, "high", None)
    if low is None or high is None:  # unbounded or discrete
        return
    low, high = low.to(action.dtype), high.to(action.dtype)
    outside = (action < low - BOUND_ROUNDING * low.abs()) | (action > high + BOUND_ROUNDING * high.abs())
    if not outside.any():
        return
    row, *position = outside.nonzero()[0].tolist()
    place = tuple(position)
    raise DataError(
        f"{action[(row, *place)].item()} lies outside the environment's bounds "
        f"[{low[place].item()}, {high[place].item()}]",
        "scale or clip the actions, or choose the environment that was recorded",
        source=source,
        column="action" + "".join(f"[{i}]" for i in place),
        row=row + 1,
    )
