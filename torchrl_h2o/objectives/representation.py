"""PAR's measure of a dynamics gap: the deviation of a transition from latent dynamics that were learnt in reality."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import cast

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams, unravel_key
from tensordict.nn import TensorDictModule, TensorDictModuleBase, dispatch
from torch import Tensor

from torchrl_h2o.objectives.batch_checks import NetworkInput, entry, network_inputs
from torchrl_h2o.objectives.hybrid_loss import HybridLoss


class RepresentationDeviation(TensorDictModuleBase):
    r"""Measure the deviation of transitions from the latent dynamics of an encoder f and a predictor g.

    .. math::
        d(s,a,s')=\tfrac 1n\big\|g(f(s),a)-f(s')\big\|^2,\qquad f(s)\in\mathbb R^n

    :class:`RepresentationLoss` trains f and g on real transitions, so the deviation is small where the dynamics are
    those of reality. ``DynamicsRewardCorrection(deviation, scale=-beta)`` subtracts it from simulated rewards. Neither
    the policy nor Q reads the representation.

    Args:
        encoder (TensorDictModule): f, writes the representation ``[*B, n]`` as its last entry.
        predictor (TensorDictModule): g, reads that representation and the action, writes the representation of the next
            state ``[*B, n]`` as its last entry.

    Keyword Args:
        next_keys (sequence of NestedKey, optional): entries of the one-step next state, in the order of
            ``encoder.in_keys``. Defaults to the same keys below ``"next"``. In n-step batches they are
            ``("next", "original_observation")``.
        out_keys (sequence of NestedKey, optional): key of the deviation, ``[*B]``, a constant. Defaults to
            ``["representation_deviation"]``.

    Raises:
        ValueError: if the predictor does not read what the encoder writes, or ``next_keys`` has another length than
            ``encoder.in_keys``.

    Source:
        PAR (Lyu et al., 2024, https://arxiv.org/abs/2405.15369). The mean over the n entries is that of the authors'
        code.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_h2o.objectives import make_representation_deviation
        >>> deviation = make_representation_deviation(observation_dim=3, action_dim=1)
        >>> batch = TensorDict(observation=torch.randn(5, 3), action=torch.randn(5, 1),
        ...                    next=TensorDict(observation=torch.randn(5, 3)), batch_size=5)
        >>> deviation(batch)["representation_deviation"].shape
        torch.Size([5])
    """

    # TorchRL annotates these as lists of flat keys.
    in_keys: list[NestedKey]
    out_keys: list[NestedKey]

    def __init__(
        self,
        encoder: TensorDictModule,
        predictor: TensorDictModule,
        *,
        next_keys: Sequence[NestedKey] | None = None,
        out_keys: Iterable[NestedKey] = ("representation_deviation",),
    ) -> None:
        super().__init__()
        latent, states = encoder.out_keys[-1], list(encoder.in_keys)
        if latent not in predictor.in_keys:
            raise ValueError(f"the predictor reads {predictor.in_keys}, not {latent!r}, which the encoder writes.")
        following = [("next", key) for key in states] if next_keys is None else next_keys
        self.next_keys = [cast(NestedKey, unravel_key(key)) for key in following]
        if len(self.next_keys) != len(states):
            raise ValueError(f"next_keys are {self.next_keys}: one for each of the encoder's {states} is needed.")
        self.encoder, self.predictor = encoder, predictor
        read = [*states, *(key for key in predictor.in_keys if key != latent), *self.next_keys]
        self.in_keys = list(dict.fromkeys(read))
        self.out_keys = list(out_keys)
        known = network_inputs(encoder)
        self.network_inputs = (*known, *(NetworkInput(tuple(self.next_keys), one.width) for one in known))

    def deviation(self, tensordict: TensorDictBase) -> Tensor:
        """Compute the deviation, ``[*B]``, of which f(s') is a constant."""
        encode, predict = self.encoder, self.predictor
        following = {key: tensordict.get(n) for key, n in zip(encode.in_keys, self.next_keys, strict=True)}
        target = encode(TensorDict(following, tensordict.batch_size)).get(encode.out_keys[-1]).detach()
        predicted = predict(encode(tensordict.select(*self.in_keys))).get(predict.out_keys[-1])
        return (predicted - target).square().mean(-1)

    @dispatch()
    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        name = "RepresentationDeviation"
        for one in self.network_inputs:
            one.check([entry(tensordict, key, name) for key in one.keys], name, None)
        return tensordict.set(self.out_keys[0], self.deviation(tensordict))


class RepresentationLoss(HybridLoss):
    r"""Train the latent dynamics of a :class:`RepresentationDeviation` on the real rows.

    .. math::
        \min_{f,g}E_{𝒟}\Big[\tfrac 1n\big\|g(f(s),a)-\mathrm{sg}\,f(s')\big\|^2\Big]

    sg is the stop-gradient: f(s') is a constant. Without it, a constant f would be a trivial minimum.

    Args:
        representation (RepresentationDeviation): holds f and g.

    Keyword Args:
        reduction (str, optional): see :class:`~torchrl_h2o.objectives.HybridLoss`.

    Reads the inputs of ``representation``, ``real`` ``[*B]`` and, if present, ``priority_weight`` ``[*B]``. Returns
    ``loss_representation`` and, for logging, ``deviation_real`` and ``deviation_sim``, the mean deviation of each
    stream; 0 for a stream without rows.

    Source:
        PAR (Lyu et al., 2024, https://arxiv.org/abs/2405.15369). The authors' code makes one such update in 200 of the
        policy's, with a target network in that of ODRL (https://github.com/OffDynamicsRL/off-dynamics-rl).

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_h2o.objectives import make_representation_deviation
        >>> loss = RepresentationLoss(make_representation_deviation(observation_dim=3, action_dim=1))
        >>> batch = TensorDict(observation=torch.randn(6, 3), action=torch.randn(6, 1), real=torch.arange(6) < 2,
        ...                    next=TensorDict(observation=torch.randn(6, 3)), batch_size=6)
        >>> loss(batch)["loss_representation"].backward()
    """

    _checked_network = "representation"
    representation: RepresentationDeviation
    representation_params: TensorDictParams

    def __init__(self, representation: RepresentationDeviation, *, reduction: str = "mean") -> None:
        super().__init__(reduction=reduction)
        self._network_inputs = representation.network_inputs
        # TorchRL accepts any compatible module, although it annotates a TensorDictModule.
        self.convert_to_functional(cast(TensorDictModule, representation), "representation")

    def _read_keys(self) -> Iterable[NestedKey]:
        return *self.representation.in_keys, self.tensor_keys.real

    def _written_keys(self) -> Iterable[NestedKey]:
        return "loss_representation", "deviation_real", "deviation_sim"

    @dispatch(source="_dispatch_keys")
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        batch = self._without_masked_rows(tensordict)
        rows = self._rows(batch)
        with self.representation_params.to_module(self.representation, preserve_module_state=False):
            deviation = self.representation.deviation(batch)
        terms = {"loss_representation": self._expectation(deviation, rows, "real")}
        for stream in ("real", "sim"):
            terms[f"deviation_{stream}"] = self._expectation(deviation.detach(), rows, stream, prioritised=False)
        return self._output(terms, tensordict)
