"""The paper's networks as TensorDict modules: two hidden layers of 256 units with ReLU, and small initial outputs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast, overload

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded, TensorSpec
from torchrl.data.tensor_specs import ContinuousBox
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator

from torchrl_h2o.objectives.ratio import DynamicsRatioEstimator
from torchrl_h2o.objectives.representation import RepresentationDeviation

HIDDEN = (256, 256)


class _OutputLayer(nn.Linear):
    """Linear layer that keeps its own precision in ``torch.autocast``: in bfloat16, a Q of 1000 is a multiple of 4."""

    def forward(self, input: Tensor) -> Tensor:
        if not torch.is_autocast_enabled(input.device.type):
            return super().forward(input)
        with torch.autocast(input.device.type, enabled=False):
            return super().forward(input.to(self.weight.dtype))


def _with_output_layer(network: MLP) -> MLP:
    last = cast(nn.Linear, network[-1])
    output = nn.utils.skip_init(_OutputLayer, last.in_features, last.out_features)  # draws no random numbers
    output.weight, output.bias = last.weight, last.bias
    network[-1] = output
    return network


def _mlp(in_features: int, out_features: int, num_cells: Sequence[int], layer_norm: bool = False) -> MLP:
    norm = {}
    if layer_norm:
        norm = {"norm_class": nn.LayerNorm, "norm_kwargs": [{"normalized_shape": width} for width in num_cells]}
    network = MLP(in_features, out_features, num_cells=list(num_cells), activation_class=nn.ReLU, **norm)
    last = cast(nn.Linear, network[-1])
    nn.init.xavier_uniform_(last.weight, gain=1e-2)
    nn.init.zeros_(last.bias)
    return _with_output_layer(network)


class GaussianParameters(nn.Module):
    """Splits a network's output ``[*B, 2 n]`` into the mean and the standard deviation of a Gaussian, ``[*B, n]`` each.

    The log standard deviation is clamped to [-20, 2], as in the authors' code, to prevent underflow and overflow.

    Args:
        trainable (bool, optional): whether the log standard deviation is scaled by a trained multiplier (initially 1)
            and shifted by a trained offset (initially -1), as in the authors' code. Defaults to ``False``.
    """

    def __init__(self, trainable: bool = False) -> None:
        super().__init__()
        self.trainable = trainable
        if trainable:
            self.multiplier = nn.Parameter(torch.tensor(1.0))
            self.offset = nn.Parameter(torch.tensor(-1.0))

    def reset_parameters(self) -> None:
        if self.trainable:
            nn.init.constant_(self.multiplier, 1.0)
            nn.init.constant_(self.offset, -1.0)

    def forward(self, output: Tensor) -> tuple[Tensor, Tensor]:
        loc, log_std = output.chunk(2, -1)
        if self.trainable:
            log_std = self.multiplier * log_std + self.offset
        return loc, log_std.clamp(-20.0, 2.0).exp()


def make_actor(
    observation_dim: int,
    action_spec: TensorSpec,
    num_cells: Sequence[int] = HIDDEN,
    *,
    trainable_log_std: bool = False,
) -> ProbabilisticActor:
    """Build a tanh-Gaussian policy within the action's bounds.

    Args:
        observation_dim (int): size of ``observation`` ``[*B, observation_dim]``.
        action_spec (TensorSpec): bounded action spec of one environment, ``[action_dim]``.
        num_cells (sequence of int, optional): hidden layers. Defaults to ``(256, 256)``.

    Keyword Args:
        trainable_log_std (bool, optional): whether to add the trained multiplier and offset of the log standard
            deviation that the authors' code has. Without them, the last layer's bias starts at the offset, so the
            initial policy is the same with two parameters fewer. Defaults to ``False``.

    Returns:
        A policy that writes ``loc``, ``scale`` and ``action`` ``[*B, action_dim]``. Its initial standard deviation
        before the tanh is exp(-1), as with the authors' log-std offset. It does not write the action's log-probability:
        the losses compute it where they need it, and collection and evaluation are faster without.

    Raises:
        ValueError: if the action is not bounded.

    Source:
        The published code of H2O+ (Niu et al., 2023, https://arxiv.org/abs/2309.12716).

    Examples:
        >>> import torch
        >>> from torchrl.data import Bounded
        >>> actor = make_actor(observation_dim=4, action_spec=Bounded(-3, 3, (1,)))
        >>> loc, scale, action = actor(observation=torch.zeros(5, 4))
        >>> action.shape
        torch.Size([5, 1])
    """
    if not isinstance(action_spec, Bounded):
        raise ValueError(f"a tanh-Gaussian policy needs a bounded action, not {type(action_spec).__name__}.")
    action_dim, space = action_spec.shape[-1], cast(ContinuousBox, action_spec.space)
    network = _mlp(observation_dim, 2 * action_dim, num_cells)
    if not trainable_log_std:
        with torch.no_grad():
            cast(nn.Linear, network[-1]).bias[action_dim:].fill_(-1.0)
    return ProbabilisticActor(
        TensorDictModule(
            nn.Sequential(network, GaussianParameters(trainable_log_std)),
            in_keys=["observation"],
            out_keys=["loc", "scale"],
        ),
        in_keys=["loc", "scale"],
        spec=action_spec,
        distribution_class=TanhNormal,
        distribution_kwargs={"low": space.low, "high": space.high},
    )


@overload
def make_qvalue(
    observation_dim: int,
    action_dim: int,
    num_cells: Sequence[int] = ...,
    *,
    layer_norm: bool = ...,
    ensemble: None = ...,
) -> ValueOperator: ...
@overload
def make_qvalue(
    observation_dim: int, action_dim: int, num_cells: Sequence[int] = ..., *, layer_norm: bool = ..., ensemble: int
) -> list[ValueOperator]: ...
def make_qvalue(
    observation_dim: int,
    action_dim: int,
    num_cells: Sequence[int] = HIDDEN,
    *,
    layer_norm: bool = False,
    ensemble: int | None = None,
) -> ValueOperator | list[ValueOperator]:
    """Build Q(s, a), which writes ``state_action_value`` ``[*B, 1]``.

    Args:
        observation_dim (int): size of ``observation``.
        action_dim (int): size of ``action``.
        num_cells (sequence of int, optional): hidden layers. Defaults to ``(256, 256)``.

    Keyword Args:
        layer_norm (bool, optional): whether each hidden layer is normalised before its ReLU. It bounds Q outside of the
            data and makes training stable. Defaults to ``False``, as in the authors' code.
        ensemble (int, optional): number of networks with independent initial parameters. Defaults to ``None``: one
            network, not a list.

    Returns:
        A network, or a list of ``ensemble`` networks. :class:`~torchrl_h2o.objectives.MixedBellmanLoss` and TorchRL's
        losses accept both, and take the minimum over the list.

    Raises:
        ValueError: if ``ensemble`` is below 1.

    Source:
        Layer normalisation: RLPD (Ball et al., 2023, https://arxiv.org/abs/2302.02948).

    Examples:
        >>> import torch
        >>> make_qvalue(4, 1)(observation=torch.zeros(5, 4), action=torch.zeros(5, 1)).shape
        torch.Size([5, 1])
        >>> len(make_qvalue(4, 1, layer_norm=True, ensemble=2))
        2
    """
    if ensemble is not None and ensemble < 1:
        raise ValueError(f"ensemble is {ensemble}: at least one network, or None for a network that is not in a list.")
    networks = [
        ValueOperator(_mlp(observation_dim + action_dim, 1, num_cells, layer_norm), in_keys=["observation", "action"])
        for _ in range(1 if ensemble is None else ensemble)
    ]
    return networks[0] if ensemble is None else networks


def make_value(observation_dim: int, num_cells: Sequence[int] = HIDDEN) -> ValueOperator:
    """Build V(s), which writes ``state_value`` ``[*B, 1]``.

    Args:
        observation_dim (int): size of ``observation``.
        num_cells (sequence of int, optional): hidden layers. Defaults to ``(256, 256)``.

    Examples:
        >>> import torch
        >>> make_value(4)(observation=torch.zeros(5, 4)).shape
        torch.Size([5, 1])
    """
    return ValueOperator(_mlp(observation_dim, 1, num_cells), in_keys=["observation"])


def make_dynamics_ratio_estimator(
    observation_dim: int,
    action_dim: int,
    num_cells: Sequence[int] = HIDDEN,
    *,
    next_observation: NestedKey = ("next", "observation"),
    with_sa_network: bool = True,
    **kwargs,
) -> DynamicsRatioEstimator:
    """Build the two discriminators of Eq. (9), or the one for transitions that differ in s' alone.

    Args:
        observation_dim (int): size of ``observation``.
        action_dim (int): size of ``action``.
        num_cells (sequence of int, optional): hidden layers. Defaults to ``(256, 256)``.

    Keyword Args:
        next_observation (NestedKey, optional): the entry of the one-step next state s'. In n-step batches it is
            ``("next", "original_observation")``; see
            :attr:`~torchrl_h2o.data.HybridReplayBuffer.next_observation`. Defaults to ``("next", "observation")``.
        with_sa_network (bool, optional): whether to build the network on (s, a). Leave it out to train on pairs with
            the same (s, a); the network on (s, a, s') then has small initial outputs, so that the ratio is near 1
            where the pairs give no evidence. Defaults to ``True``.
        **kwargs: keyword arguments of :class:`DynamicsRatioEstimator`.

    Examples:
        >>> make_dynamics_ratio_estimator(17, 6, logit_bound=None).in_keys
        ['observation', 'action', ('next', 'observation')]
    """
    keys = ["observation", "action", next_observation]
    sa_dim, sas_dim = observation_dim + action_dim, 2 * observation_dim + action_dim
    sa = None
    if with_sa_network:
        hidden = {"num_cells": list(num_cells), "activation_class": nn.ReLU}
        sa_network = _with_output_layer(MLP(sa_dim, 2, **hidden))
        sa = TensorDictModule(sa_network, in_keys=keys[:2], out_keys=["sa_logits"])
        network = _with_output_layer(MLP(sas_dim, 2, **hidden))
    else:
        network = _mlp(sas_dim, 2, num_cells)
    sas = TensorDictModule(network, in_keys=keys, out_keys=["sas_logits"])
    return DynamicsRatioEstimator(sa, sas, next_observation=next_observation, **kwargs)


def make_dynamics_model(
    observation_dim: int, action_dim: int, num_cells: Sequence[int] = HIDDEN, *, ensemble: int = 7
) -> list[TensorDictModule]:
    """Build models of the change of the observation for :class:`~torchrl_h2o.objectives.DynamicsModelLoss`.

    Args:
        observation_dim (int): size of ``observation``.
        action_dim (int): size of ``action``.
        num_cells (sequence of int, optional): hidden layers. Defaults to ``(256, 256)``.

    Keyword Args:
        ensemble (int, optional): number of models with independent initial parameters. Defaults to 7.

    Returns:
        Networks that write ``change`` ``[*B, 2 observation_dim]``.

    Raises:
        ValueError: if ``ensemble`` is below 2, because the spread of one model is not defined.

    Examples:
        >>> import torch
        >>> make_dynamics_model(4, 1)[0](observation=torch.zeros(5, 4), action=torch.zeros(5, 1)).shape
        torch.Size([5, 8])
    """
    if ensemble < 2:
        raise ValueError(f"ensemble is {ensemble}: the spread of the predictions needs at least two models.")
    sizes = observation_dim + action_dim, 2 * observation_dim, num_cells
    return [
        TensorDictModule(_mlp(*sizes), in_keys=["observation", "action"], out_keys=["change"]) for _ in range(ensemble)
    ]


class _MeanAbsoluteNorm(nn.Module):
    """Divides a vector by the mean of its absolute values, so that a representation cannot shrink to zero."""

    def forward(self, x: Tensor) -> Tensor:
        return x / x.abs().mean(-1, keepdim=True).clamp_min(1e-8)


def make_representation_deviation(
    observation_dim: int,
    action_dim: int,
    num_cells: Sequence[int] = HIDDEN,
    *,
    next_observation: NestedKey = ("next", "observation"),
) -> RepresentationDeviation:
    """Build the encoders of PAR: perceptrons with ELU, and a representation as wide as the last hidden layer.

    Args:
        observation_dim (int): size of ``observation``.
        action_dim (int): size of ``action``.
        num_cells (sequence of int, optional): hidden layers. Defaults to ``(256, 256)``.

    Keyword Args:
        next_observation (NestedKey, optional): the entry of the one-step next state s'; see
            :func:`make_dynamics_ratio_estimator`. Defaults to ``("next", "observation")``.

    Source:
        The published code of PAR (Lyu et al., 2024, https://arxiv.org/abs/2405.15369).

    Examples:
        >>> make_representation_deviation(17, 6).in_keys
        ['observation', 'action', ('next', 'observation')]
    """
    width, hidden = num_cells[-1], {"num_cells": list(num_cells), "activation_class": nn.ELU}
    encoder = nn.Sequential(MLP(observation_dim, width, **hidden), _MeanAbsoluteNorm())
    predictor = MLP(width + action_dim, width, **hidden)
    return RepresentationDeviation(
        TensorDictModule(encoder, in_keys=["observation"], out_keys=["representation"]),
        TensorDictModule(predictor, in_keys=["representation", "action"], out_keys=["next_representation"]),
        next_keys=[next_observation],
    )
