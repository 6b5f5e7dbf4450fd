"""An ensemble of Gaussian models of the real dynamics, and the loss that trains it on real transitions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import cast

import torch
from tensordict import NestedKey, TensorDictBase, TensorDictParams, unravel_key
from tensordict.nn import TensorDictModule, dispatch
from torch import Tensor

from torchrl_h2o.objectives.batch_checks import network_inputs
from torchrl_h2o.objectives.hybrid_loss import HybridLoss

LOG_STD = (-5.0, 0.25)  # bounds of log σ, in units of ``change_scale``: half of the authors' of log σ², -10 and 0.5


class DynamicsModelLoss(HybridLoss):
    r"""Negative log-likelihood of the real transitions, for M Gaussian models of the change of the observation.

    .. math::
        \min_\phi\sum_{i=1}^M E_{𝒟}\Big[\tfrac 1n\sum_j\tfrac{(y_j-\mu_{ij})^2}{2\sigma_{ij}^2}+\log\sigma_{ij}\Big],
        \qquad y=\frac{s'-s}{\text{change\_scale}}\in\mathbb R^n

    Args:
        network (TensorDictModule or list of them): reads observation and action, writes ``[*B, 2 n]`` as its last
            entry: μ, and a number that a tanh maps to log σ in [-5, 0.25]. A list is an ensemble of independent
            initialisations; one module is expanded to ``num_models``.

    Keyword Args:
        num_models (int, optional): M. Defaults to 7, as in the authors' code.
        change_scale (Tensor, optional): ``[n]``, in the unit of each observation, for example
            :func:`fit_change_scale`. Defaults to 1.
        observation, next_observation (NestedKey, optional): entries of s and of the one-step s'. Default to
            ``"observation"`` and ``("next", "observation")``.
        reduction (str, optional): see :class:`~torchrl_h2o.objectives.HybridLoss`.

    Raises:
        ValueError: if the network's output does not fit the observation.

    Reads the network's inputs, s, s', ``real`` ``[*B]`` and, if present, ``priority_weight`` ``[*B]``. Returns
    ``loss_dynamics``, the sum over the models.

    Source:
        VGDF (Xu et al., 2023, https://arxiv.org/abs/2305.17625), which has Gaussian models of s'. The authors' code
        also predicts the reward, and fits the models anew as real data come in; here the real data are fixed.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_h2o.objectives import make_dynamics_model
        >>> loss = DynamicsModelLoss(make_dynamics_model(observation_dim=3, action_dim=1))
        >>> batch = TensorDict(observation=torch.randn(6, 3), action=torch.randn(6, 1), real=torch.arange(6) < 2,
        ...                    next=TensorDict(observation=torch.randn(6, 3)), batch_size=6)
        >>> loss(batch)["loss_dynamics"].backward()
        >>> loss.sample(batch).shape
        torch.Size([7, 6, 3])
    """

    _checked_network = "network"
    network: TensorDictModule
    network_params: TensorDictParams
    change_scale: Tensor

    def __init__(
        self,
        network: TensorDictModule | Sequence[TensorDictModule],
        *,
        num_models: int = 7,
        change_scale: Tensor | None = None,
        observation: NestedKey = "observation",
        next_observation: NestedKey = ("next", "observation"),
        reduction: str = "mean",
    ) -> None:
        super().__init__(reduction=reduction)
        self._network_inputs = tuple(network_inputs(network))
        networks = list(network) if isinstance(network, Sequence) else network
        num_models = len(networks) if isinstance(networks, list) else num_models
        # TorchRL accepts a list of networks, although it annotates one.
        self.convert_to_functional(cast(TensorDictModule, networks), "network", num_models)
        self.observation, self.next_observation = unravel_key(observation), unravel_key(next_observation)
        scale = torch.ones(()) if change_scale is None else change_scale
        self.register_buffer("change_scale", scale.to(self._dtype_of("network")))
        _ = self.vmap_randomness  # TorchRL sets it at the first access, which must not be inside a compiled forward

    def _read_keys(self) -> Iterable[NestedKey]:
        return *self.network.in_keys, self.observation, self.next_observation, self.tensor_keys.real

    def _written_keys(self) -> Iterable[NestedKey]:
        return ("loss_dynamics",)

    def parameters_of_change(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Compute μ and log σ of the change in units of ``change_scale``, ``[M, *B, n]`` each."""
        loc, raw = self._call("network", tensordict).get(self.network.out_keys[-1]).chunk(2, -1)
        low, high = LOG_STD
        return loc, low + (high - low) * (1 + torch.tanh(raw)) / 2

    @torch.no_grad()
    def sample(self, tensordict: TensorDictBase) -> Tensor:
        """Draw a next observation from each model, ``[M, *B, n]``, in the observation's units."""
        loc, log_std = self.parameters_of_change(tensordict)
        change = loc + log_std.exp() * torch.randn_like(loc)
        return self._entry(tensordict, self.observation) + self.change_scale * change

    @dispatch(source="_dispatch_keys")
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        batch = self._without_masked_rows(tensordict)
        rows, (loc, log_std) = self._rows(batch), self.parameters_of_change(batch)
        change = self._entry(batch, self.next_observation) - self._entry(batch, self.observation)
        if change.shape != loc.shape[1:]:
            raise ValueError(
                f"{type(self).__name__}: the network writes {list(loc.shape[1:])} means, and the change of "
                f"{self.observation!r} has the shape {list(change.shape)}."
            )
        error = (change / self.change_scale - loc) * (-log_std).exp()
        terms = (error.square() / 2 + log_std).mean(-1).sum(0)
        return self._output({"loss_dynamics": self._expectation(terms, rows, "real")}, tensordict)
