"""Run plain perceptrons, and ensembles of them, as matrix products.

To call a module with parameters stored outside of it, and to ``vmap`` over an ensemble, takes longer than the products
of a small network: without this file, an uncompiled update takes a fifth longer.
"""

from __future__ import annotations

from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.modules import MLP, ValueOperator

Layers = list[tuple[tuple[str, ...], nn.Module]]
_ELEMENTWISE = (nn.ReLU, nn.Tanh, nn.ELU, nn.SiLU, nn.GELU, nn.Mish, nn.LeakyReLU, nn.Sigmoid, nn.Softplus, nn.Identity)


def perceptron_output(
    network: TensorDictModuleBase, inputs: TensorDictBase, params: TensorDictBase
) -> TensorDictBase | None:
    """Run a perceptron: linear layers, layer normalisations of the last axis and elementwise functions, without hooks.

    Args:
        network: the module. The parameters it holds are not used.
        inputs: ``[*B]``.
        params: parameters of one network, ``[]``, or of an ensemble, ``[N]``.

    Returns:
        A tensordict with the output, ``[*B]`` or ``[N, *B]``; None for any other network, and in ``torch.autocast``.
    """
    layers = _layers(network)
    if layers is None:
        return None
    x = torch.cat([cast(Tensor, inputs.get(key)) for key in network.in_keys], -1)
    if torch.is_autocast_enabled(x.device.type):  # modules choose their precision themselves
        return None
    rows, x = x.shape[:-1], x.reshape(-1, x.shape[-1])
    for path, layer in layers:
        x = layer(x) if isinstance(layer, _ELEMENTWISE) else _apply(layer, x, params.get(path))
    batch_size = (*params.batch_size, *rows)
    return TensorDict({network.out_keys[0]: x.reshape(*batch_size, x.shape[-1])}, batch_size=batch_size)


def _layers(network: TensorDictModuleBase) -> Layers | None:
    """List the layers of a perceptron, each with the path to its parameters; None for any other network."""
    if type(network) not in (TensorDictModule, ValueOperator) or len(network.out_keys) != 1:
        return None
    if len(network.in_keys) > 1 and type(network.module) is not MLP:
        return None  # only MLP concatenates its inputs
    layers: Layers = []
    for name, layer in network.named_modules():
        if layer._forward_hooks or layer._forward_pre_hooks:
            return None
        if layer is network or type(layer) is nn.Sequential or (type(layer) is MLP and not layer._reshape_out):
            continue
        normalises = type(layer) is nn.LayerNorm and len(layer.normalized_shape) == 1 and layer.bias is not None
        if not (normalises or isinstance(layer, nn.Linear) or type(layer) in _ELEMENTWISE):
            return None
        layers.append((tuple(name.split(".")), layer))
    return layers if any(isinstance(layer, nn.Linear) for _, layer in layers) else None


def _apply(layer: nn.Module, x: Tensor, params: TensorDictBase) -> Tensor:
    """Apply the layer of one network to ``[B, in]``, or those of an ensemble to ``[B, in]`` or ``[N, B, in]``."""
    weight, bias = params.get("weight"), params.get("bias", None)
    if isinstance(layer, nn.LayerNorm):
        if weight.ndim == 1:
            return F.layer_norm(x, layer.normalized_shape, weight, bias, layer.eps)
        return torch.addcmul(
            bias.unsqueeze(1), F.layer_norm(x, layer.normalized_shape, eps=layer.eps), weight.unsqueeze(1)
        )
    if weight.ndim == 2:
        return F.linear(x, weight, bias)
    x = x.expand(len(weight), *x.shape[-2:])
    return torch.bmm(x, weight.mT) if bias is None else torch.baddbmm(bias.unsqueeze(1), x, weight.mT)
