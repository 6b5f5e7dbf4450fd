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
from torch.distributions import Distribution, Independent, Normal
from torch.nn import functional as F
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives.utils import _vmap_func

from torchrl_h2o.objectives.relu_perceptron import relu, relu_perceptron

_ELEMENTWISE = (nn.ReLU, nn.Tanh, nn.ELU, nn.SiLU, nn.GELU, nn.Mish, nn.LeakyReLU, nn.Sigmoid, nn.Softplus, nn.Identity)
_PLAIN = (TensorDictModule, ValueOperator)

Path = tuple[str, ...]


class LastAxis(nn.Module):
    """Base of modules without parameters that act on the last axis alone, so that batch axes may be as they like."""


def run(
    network: TensorDictModuleBase,
    tensordict: TensorDictBase,
    params: TensorDictBase,
    randomness: str = "error",
    *,
    frozen: bool = False,
) -> TensorDictBase:
    """What a network writes.

    Args:
        network: whose own parameters are not looked at.
        tensordict: what it reads, ``[*B]``, and maybe more.
        params: its parameters, ``[]``, or those of an ensemble, ``[N]``.
        randomness: of ``vmap``, for an ensemble that draws.
        frozen: the parameters are constants; gradients reach the inputs alone.

    Returns:
        A tensordict with the network's ``out_keys``, ``[*B]`` or ``[N, *B]``.
    """
    layers = _layers(network)
    if layers is not None:
        x = [tensordict.get(key) for key in network.in_keys]
        outputs = _perceptron(layers, x[0] if len(x) == 1 else torch.cat(x, -1), params, frozen)
        outputs = outputs if isinstance(outputs, tuple) else (outputs,)
        if len(outputs) == len(network.out_keys):
            out = TensorDict({}, batch_size=(*params.batch_size, *tensordict.batch_size))
            for key, value in zip(network.out_keys, outputs, strict=True):
                out.set(key, value)
            return out
    inputs, params = tensordict.select(*network.in_keys), params.data if frozen else params
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


def sample_from_noise(policy: Distribution, noise: Tensor) -> tuple[Tensor, Tensor]:
    """A reparameterised sample and its log-probability, from given standard normal numbers.

    Args:
        policy: a Gaussian over ``[*B, n]``, maybe behind transforms, such as TorchRL's ``TanhNormal``.
        noise: ``[*B, n]``.

    Raises:
        TypeError: for a distribution of another kind.
    """
    transforms = getattr(policy, "transforms", ())
    base = policy.base_dist if transforms else policy
    if not isinstance(base, Independent) or not isinstance(base.base_dist, Normal):
        raise TypeError(f"noise is given for Gaussian policies alone, and {type(policy).__name__} is not made of one.")
    sample = base.mean + noise * base.stddev
    log_prob = base.log_prob(sample)
    for transform in transforms:
        before, sample = sample, transform(sample)
        log_prob = log_prob - transform.log_abs_det_jacobian(before, sample).sum(-1)
    return sample, log_prob


def _layers(network: nn.Module) -> list[tuple[Path, nn.Module]] | None:
    """The layers of a perceptron, each with where its parameters lie; None if the network is anything else."""
    several = len(network.in_keys) > 1
    if type(network) not in _PLAIN or _is_hooked(network) or (several and type(network.module) is not MLP):
        return None
    layers = list(_flat(network.module, ("module",)))
    plain = all(_is_plain(layer) for _, layer in layers) and any(type(layer) is nn.Linear for _, layer in layers)
    return layers if plain else None


def _flat(module: nn.Module, path: Path) -> Iterator[tuple[Path, nn.Module]]:
    is_chain = type(module) is nn.Sequential or (type(module) is MLP and not module._reshape_out)
    if is_chain and not _is_hooked(module):
        for name, child in module.named_children():
            yield from _flat(child, (*path, name))
    else:
        yield path, module


def _is_plain(layer: nn.Module) -> bool:
    return (type(layer) in (nn.Linear, *_ELEMENTWISE) or isinstance(layer, LastAxis)) and not _is_hooked(layer)


def _is_hooked(module: nn.Module) -> bool:
    return bool(module._forward_hooks or module._forward_pre_hooks)


def _perceptron(
    layers: list[tuple[Path, nn.Module]], x: Tensor, params: TensorDictBase, frozen: bool
) -> Tensor | tuple[Tensor, ...]:
    batch_size = x.shape[:-1]
    x = x.reshape(-1, x.shape[-1])
    compiling = torch.compiler.is_compiling()
    layer_by_layer = compiling or torch.is_autocast_enabled(x.device.type)  # which see into layers
    depth = 0 if layer_by_layer else _depth_with_relu(layers)
    if depth:
        linear = [_weight_and_bias(params, path, frozen) for path, _ in layers[: 2 * depth - 1 : 2]]
        x = relu_perceptron(x, *zip(*linear, strict=True))
        layers = layers[2 * depth - 1 :]
    for path, layer in layers:
        if type(layer) is not nn.Linear:
            x = relu(x) if compiling and type(layer) is nn.ReLU else layer(x)
            continue
        weight, bias = _weight_and_bias(params, path, frozen)
        if weight.ndim == 2:
            x = F.linear(x, weight, bias)
        else:
            x = x.expand(weight.shape[0], *x.shape[-2:])
            x = torch.bmm(x, weight.mT) if bias is None else torch.baddbmm(bias.unsqueeze(1), x, weight.mT)
    if isinstance(x, tuple):
        return tuple(part.reshape(*params.batch_size, *batch_size, part.shape[-1]) for part in x)
    return x.reshape(*params.batch_size, *batch_size, x.shape[-1])


def _depth_with_relu(layers: list[tuple[Path, nn.Module]]) -> int:
    """How many linear layers, each with a bias, follow each other with ReLU between them and nothing else."""
    depth = 0
    for index, (_, layer) in enumerate(layers):
        if type(layer) is not (nn.ReLU if index % 2 else nn.Linear):
            break
        if not index % 2:
            if layer.bias is None:
                break
            depth += 1
    return depth


def _weight_and_bias(params: TensorDictBase, path: Path, frozen: bool) -> tuple[Tensor, Tensor | None]:
    own = params.get(path)
    weight, bias = own.get("weight"), own.get("bias", None)
    if frozen:
        weight, bias = weight.detach(), None if bias is None else bias.detach()
    return weight, bias
