"""A network's outputs as a function of its parameters, of one set of them or of an ensemble's.

TorchRL's losses keep parameters apart from modules. Putting them into a module for a forward, and through ``vmap`` for
an ensemble, costs more than the products of a small network. A multilayer perceptron is a few products, so that one is
written out here; everything else goes TorchRL's way.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torch.distributions import Distribution
from torch.nn import functional as F
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives.utils import _vmap_func

_ELEMENTWISE = (nn.ReLU, nn.Tanh, nn.ELU, nn.SiLU, nn.GELU, nn.Mish, nn.LeakyReLU, nn.Sigmoid, nn.Softplus, nn.Identity)
_PLAIN = (TensorDictModule, ValueOperator)

Path = tuple[str, ...]


class LastAxis(nn.Module):
    """Base of modules without parameters that act on the last axis alone, so that batch axes may be as they like."""


def run(
    network: TensorDictModuleBase, tensordict: TensorDictBase, params: TensorDictBase, randomness: str = "error"
) -> TensorDictBase:
    """What a network writes.

    Args:
        network: whose own parameters are not looked at.
        tensordict: what it reads, ``[*B]``, and maybe more.
        params: its parameters, ``[]``, or those of an ensemble, ``[N]``.
        randomness: of ``vmap``, for an ensemble that draws.

    Returns:
        A tensordict with the network's ``out_keys``, ``[*B]`` or ``[N, *B]``.
    """
    inputs = tensordict.select(*network.in_keys)
    layers = _layers(network)
    if layers is not None:
        x = [inputs.get(key) for key in network.in_keys]
        outputs = _perceptron(layers, x[0] if len(x) == 1 else torch.cat(x, -1), params)
        outputs = outputs if isinstance(outputs, tuple) else (outputs,)
        if len(outputs) == len(network.out_keys):
            out = TensorDict({}, batch_size=(*params.batch_size, *tensordict.batch_size))
            for key, value in zip(network.out_keys, outputs, strict=True):
                out.set(key, value)
            return out
    if params.ndim:
        return _vmap_func(network, (None, 0), randomness=randomness)(inputs, params)
    with params.to_module(network, preserve_module_state=False):
        return network(inputs)


def distribution(
    network: ProbabilisticTensorDictSequential, tensordict: TensorDictBase, params: TensorDictBase
) -> Distribution:
    """The distribution of a policy with other parameters than its own.

    Args:
        network: the policy.
        tensordict: what it reads, ``[*B]``.
        params: its parameters, ``[]``.
    """
    modules = getattr(network, "module", ())
    if len(modules) == 2 and _layers(modules[0]) is not None:
        return modules[1].get_dist(run(modules[0], tensordict, params.get(("module", "0"))))
    with params.to_module(network, preserve_module_state=False):
        return network.get_dist(tensordict.select(*network.in_keys))


def _layers(network: nn.Module) -> list[tuple[Path, nn.Module]] | None:
    """The layers of a perceptron, each with where its parameters lie; None if the network is anything else."""
    if type(network) not in _PLAIN or (len(network.in_keys) > 1 and type(network.module) is not MLP):
        return None
    layers = list(_flat(network.module, ("module",)))
    plain = all(_is_plain(layer) for _, layer in layers) and any(type(layer) is nn.Linear for _, layer in layers)
    return layers if plain else None


def _flat(module: nn.Module, path: Path) -> Iterator[tuple[Path, nn.Module]]:
    if type(module) is nn.Sequential or (type(module) is MLP and not module._reshape_out):
        for name, child in module.named_children():
            yield from _flat(child, (*path, name))
    else:
        yield path, module


def _is_plain(layer: nn.Module) -> bool:
    hooked = layer._forward_hooks or layer._forward_pre_hooks
    return (type(layer) in (nn.Linear, *_ELEMENTWISE) or isinstance(layer, LastAxis)) and not hooked


def _perceptron(layers: list[tuple[Path, nn.Module]], x: Tensor, params: TensorDictBase) -> Tensor | tuple[Tensor, ...]:
    if not params.ndim:
        for path, layer in layers:
            x = F.linear(x, *_weight_and_bias(params, path)) if type(layer) is nn.Linear else layer(x)
        return x
    (members,), batch_size = params.batch_size, x.shape[:-1]
    x, is_shared = x.reshape(-1, x.shape[-1]), True
    for path, layer in layers:
        if type(layer) is not nn.Linear:
            x = layer(x)
            continue
        weight, bias = _weight_and_bias(params, path)
        if is_shared:  # one product for all members, as they read the same
            bias = None if bias is None else bias.flatten(0, 1)
            x = F.linear(x, weight.flatten(0, 1), bias).unflatten(-1, (members, -1)).movedim(-2, 0)
            is_shared = False
        else:
            x = torch.bmm(x, weight.mT) if bias is None else torch.baddbmm(bias.unsqueeze(1), x, weight.mT)
    if isinstance(x, tuple):
        return tuple(part.reshape(members, *batch_size, part.shape[-1]) for part in x)
    return x.reshape(members, *batch_size, x.shape[-1])


def _weight_and_bias(params: TensorDictBase, path: Path) -> tuple[Tensor, Tensor | None]:
    own = params.get(path)
    return own.get("weight"), own.get("bias", None)
