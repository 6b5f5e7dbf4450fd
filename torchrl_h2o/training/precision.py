"""Precision of the matrix products in losses: float32, or bfloat16 on processors that have instructions for it."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_h2o.objectives import HybridLoss
from torchrl_h2o.options.types import has_bf16

PRECISIONS = ("float32", "bf16")


def at_precision(losses_of: Callable, precision: str) -> Callable:
    """Returns the losses with the matrix products of their hidden layers in the given precision.

    Parameters, the last layer of each network, losses and the optimiser stay in float32.

    Args:
        losses_of: a loss of this library, such as :class:`~torchrl_h2o.objectives.H2OPlusLoss`.
        precision: ``"float32"``, or ``"bf16"`` for ``torch.autocast`` with bfloat16.

    Raises:
        ValueError: for another precision, for bf16 on a processor without instructions for it (it would be slower than
            float32 there), and for bf16 with losses whose networks would also end in bfloat16.
    """
    if precision == "float32":
        return losses_of
    if precision not in PRECISIONS:
        raise ValueError(f"precision={precision}: choose {' or '.join(PRECISIONS)}")
    if not isinstance(losses_of, HybridLoss):
        raise ValueError("precision=bf16 is for method=h2o_plus and method=rlpd: leave it out with other methods")
    if not has_bf16():
        raise ValueError("precision=bf16: this processor has no bfloat16 instructions; choose float32, it is faster")

    def mixed(*batches: TensorDictBase, **noise: Any) -> Mapping[str, Tensor]:
        with torch.autocast("cpu", dtype=torch.bfloat16):
            return losses_of(*batches, **noise)

    return mixed
