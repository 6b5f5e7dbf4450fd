"""Updates on a GPU as CUDA graphs, which start all kernels of an update with one call.

An update of small networks consists of more than a thousand short kernels, which Python starts one by one.
"""

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import CudaGraphModule


def as_cuda_graph(update: Callable, device: torch.device) -> Callable:
    """Returns a function that is captured as a CUDA graph at its second call.

    Args:
        update: function of tensordicts on the GPU, or without arguments, that returns detached tensors and tensordicts.
            It must not wait for the GPU, and all shapes stay the same.
        device: the GPU.
    """

    def on_copies(*batches: TensorDictBase) -> Any:
        # shallow: a graph reads the tensors that the batches hold, and an update such as DARC's, which corrects
        # rewards, puts others in their place
        return update(*(batch.copy() for batch in batches))

    return CudaGraphModule(on_copies, device=device)


def fit_to_device(optimiser: torch.optim.Optimizer, device: torch.device) -> None:
    """Lets a CUDA graph capture an optimiser's steps on a GPU; on a CPU, sets everything back.

    The learning rates become tensors, which a schedule changes in place: a graph would keep numbers as they were. Call
    this function before the first update and after a checkpoint is loaded, because that restores the settings of the
    device on which it was saved.

    Args:
        optimiser: Adam.
        device: device of its parameters.
    """
    on_gpu = device.type == "cuda"
    for group in optimiser.param_groups:
        rate = float(group["lr"])
        group.update(capturable=on_gpu, lr=torch.tensor(rate, device=device) if on_gpu else rate)
