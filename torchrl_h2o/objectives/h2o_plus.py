"""H2O+: mixed Bellman update, in-sample value loss, policy (10), temperature and dynamics ratio (9) in one loss."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, cast

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor, nn
from torch.nn.parameter import is_lazy
from torchrl.objectives import LossModule

from torchrl_h2o.objectives.bellman import MixedBellmanLoss
from torchrl_h2o.objectives.hybrid_loss import Rows
from torchrl_h2o.objectives.loss_wrapper import LossWrapper
from torchrl_h2o.objectives.policy import action_dim_of
from torchrl_h2o.objectives.ratio import DynamicsRatioLoss
from torchrl_h2o.objectives.value import InSampleValueLoss


class H2OPlusLoss(LossWrapper):
    r"""All losses of H2O+. Add the ``loss_*`` terms and minimise the sum with one optimiser.

    .. math::
        \max_\pi E_{𝒟\cup B}[Q(s,a)-\beta\log\pi(a|s)]

    Each term trains one part (the paper's equation in brackets): ``loss_value`` trains V (4), ``loss_qvalue`` Q (7, 8),
    ``loss_actor`` the policy (10), ``loss_alpha`` β, ``loss_ratio_sa`` and ``loss_ratio_sas`` the discriminators (9).
    Actions are continuous. Parameters that networks share are trained by the losses of all of them, unless
    ``bellman_loss`` has ``separate_losses=True``.

    Args:
        bellman_loss (MixedBellmanLoss): holds the policy, Q and β, and reads V. Its β becomes a trained parameter
            unless ``fixed_alpha`` is true.
        value_loss (InSampleValueLoss, optional): the backbone, built from the same value network as ``bellman_loss``.
            Without it, and with ``mixing=0.0``, the loss is SAC on both streams, Eq. (6).
        ratio_loss (DynamicsRatioLoss, optional): holds the discriminators. Their ratio weights the simulated rows.
            Without it, the batch's ``dynamics_ratio`` weights them; if the batch has none, the weight is 1.

    Keyword Args:
        weighted (bool, optional): whether the ratio weights the simulated rows. With ``False`` the discriminators are
            still trained, but the weight is 1. Defaults to ``True``.
        fixed_alpha (bool, optional): whether β stays constant. Defaults to ``False``.
        cloning (float, optional): ν of a term that keeps the policy near the actions of the real data. ``loss_actor``
            is then multiplied by :math:`\nu/\overline{|Q|}`, with the batch's mean of |Q| at the policy's actions, and
            ``loss_cloning`` is :math:`E_{𝒟}[(a_\pi-a)^2]`, the mean over the action's dimensions, in its squared unit.
            A smaller ν is nearer to the data. Defaults to ``None``: no such term.
        target_entropy (float or "auto", optional): in nats. ``"auto"``, the default, is -dim(A), from the actor's
            spec; of several agents, -dim(A) of one agent.

    Raises:
        ValueError: if ``bellman_loss`` and ``value_loss`` do not share V, if their reductions differ, if the target
            entropy is "auto" and the actor has no action spec, or if ν is not positive.

    ``loss(batch)`` trains the discriminators on the same batch. ``loss(batch, pairs)`` trains them on the second batch,
    as the authors do (``batch`` with 128 + 128 rows, ``pairs`` with 256 + 256). Reads the inputs of its parts. Returns
    the losses above and values for logging: ``alpha`` and ``entropy``; with a ``ratio_loss`` also ``accuracy_sa`` and
    ``accuracy``; if weighted also, of the simulated rows, ``dynamics_ratio``, the mean clamped ratio (the mean weight),
    ``unclamped_ratio``, the mean ratio without clamp (1 for a correct ratio), and ``effective_sample_size``, (Σ w)² /
    Σ w² of the weights w as a fraction of the rows.

    The ratio is computed before this step's update, so that all losses share one backward pass and compile to one
    graph. It is that of the discriminators' present parameters or, if ``ratio_loss`` has ``delay_estimator=True``, of
    their averaged target networks. The authors' code computes it after the discriminators' update. To reproduce that
    order, omit ``ratio_loss`` here, take the step of a separate :class:`DynamicsRatioLoss` first, and write the
    estimator's ``dynamics_ratio`` into the batch.

    Source:
        H2O+ (Niu et al., 2023, https://arxiv.org/abs/2309.12716), Eqs. (4) to (10); β as in SAC (Haarnoja et al.,
        2018, https://arxiv.org/abs/1812.05905).

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_h2o.objectives import (DynamicsRatioLoss, ExpectileValueLoss, H2OPlusLoss, MixedBellmanLoss,
        ...     make_actor, make_dynamics_ratio_estimator, make_qvalue, make_value)
        >>> actor = make_actor(observation_dim=3, action_spec=Bounded(-1, 1, (1,)))
        >>> q1, q2, value = make_qvalue(3, 1), make_qvalue(3, 1), make_value(3)
        >>> loss = H2OPlusLoss(
        ...     MixedBellmanLoss(actor, [q1, q2], value, mixing=0.1),
        ...     value_loss=ExpectileValueLoss(value, expectile=0.7),
        ...     ratio_loss=DynamicsRatioLoss(make_dynamics_ratio_estimator(3, 1)))
        >>> optimiser = torch.optim.Adam(loss.parameters(), lr=3e-4)
        >>> targets = SoftUpdate(loss, tau=0.005)
        >>> batch = TensorDict(observation=torch.randn(8, 3), action=torch.rand(8, 1), real=torch.arange(8) < 4,
        ...                    next=TensorDict(observation=torch.randn(8, 3), reward=torch.randn(8, 1),
        ...                                    terminated=torch.zeros(8, 1, dtype=torch.bool)), batch_size=8)
        >>> losses = loss(batch)
        >>> sum(term for name, term in losses.items() if name.startswith("loss_")).backward()
        >>> optimiser.step()
        >>> targets.step()
    """

    _AcceptedKeys = MixedBellmanLoss._AcceptedKeys
    _inside_name = "bellman_loss"

    bellman_loss: MixedBellmanLoss
    value_loss: InSampleValueLoss | None
    ratio_loss: DynamicsRatioLoss | None
    target_entropy: Tensor

    def __init__(
        self,
        bellman_loss: MixedBellmanLoss,
        value_loss: InSampleValueLoss | None = None,
        ratio_loss: DynamicsRatioLoss | None = None,
        *,
        weighted: bool = True,
        fixed_alpha: bool = False,
        cloning: float | None = None,
        target_entropy: float | str = "auto",
    ) -> None:
        if cloning is not None and not cloning > 0:
            raise ValueError(f"cloning must be positive, or None for no such term, not {cloning}.")
        _check_shared_value(bellman_loss, value_loss)
        super().__init__(bellman_loss, reduction=bellman_loss.reduction)
        self.value_loss = value_loss
        self.ratio_loss = ratio_loss
        self.weighted = weighted
        self.cloning = cloning
        for part in self._parts:
            if part.reduction != self.reduction:
                raise ValueError(
                    f"{type(part).__name__} has reduction={part.reduction!r} and {type(bellman_loss).__name__} "
                    f"{self.reduction!r}: build both alike."
                )
        if ratio_loss is not None:  # one record, in which SoftUpdate notes that it updates the target networks of both
            bellman_loss._has_update_associated |= ratio_loss._has_update_associated
            ratio_loss._has_update_associated = bellman_loss._has_update_associated
        if value_loss is not None:  # one container, so that conversions of dtype or device keep V shared
            value_loss.value_network_params = bellman_loss.value_network_params
            value_loss._constants = bellman_loss._constants
        if not fixed_alpha:
            log_alpha = bellman_loss.log_alpha.detach()
            del bellman_loss.log_alpha
            bellman_loss.log_alpha = nn.Parameter(log_alpha)
        if target_entropy == "auto":
            action_dim = action_dim_of(bellman_loss.actor_network, self.tensor_keys.action)
            if action_dim is None:
                raise ValueError(
                    "target_entropy='auto' needs the action's spec: give it to the actor "
                    "(ProbabilisticActor(..., spec=env.action_spec)), or pass target_entropy=-action_dim."
                )
            target_entropy = -float(action_dim)
        self.register_coeff_buffer("target_entropy", cast(float, target_entropy), dtype=bellman_loss.mixing.dtype)

    @property
    def _parts(self) -> list[LossModule]:
        return [part for part in (self.bellman_loss, self.value_loss, self.ratio_loss) if part is not None]

    @property
    def tensor_keys(self) -> MixedBellmanLoss._AcceptedKeys:
        return self.bellman_loss.tensor_keys

    def set_keys(self, **kwargs) -> None:
        """Rename keys in all parts that read them."""
        self.bellman_loss.set_keys(**kwargs)
        for part in self._parts[1:]:
            part.set_keys(**{key: value for key, value in kwargs.items() if hasattr(part.tensor_keys, key)})

    @property
    def mixing(self) -> Tensor:
        """λ of Eq. (7), ``[]``. Assign a number to change it."""
        return self.bellman_loss.mixing

    @mixing.setter
    def mixing(self, value: float) -> None:
        self.bellman_loss.mixing = value

    @property
    def gamma(self) -> Tensor:
        """γ of Eq. (7), ``[]``. Assign a number to change it."""
        return self.bellman_loss.gamma

    @gamma.setter
    def gamma(self, value: float) -> None:
        self.bellman_loss.gamma = value

    @property
    def alpha(self) -> Tensor:
        """β, the weight of the entropy, as a constant, ``[]``."""
        return self.bellman_loss.alpha

    def __getattr__(self, name: str) -> Any:
        if name in ("estimator_params", "target_estimator_params"):
            return getattr(self.ratio_loss, name)
        reached = ("actor_network", "qvalue_network", "value_network", "log_alpha")
        if name in reached and (inside := self._inside_if_set) is not None:
            return getattr(inside, name)
        return super().__getattr__(name)

    def _read_keys(self) -> Iterable[NestedKey]:
        bellman = self.bellman_loss
        return (
            *bellman.in_keys,
            *bellman.actor_network.in_keys,
            *(() if self.value_loss is None else self.value_loss.value_network.in_keys),
            *(() if self.ratio_loss is None else self.ratio_loss.in_keys),
        )

    def _optional_keys(self) -> Iterable[NestedKey]:
        unread = {self.tensor_keys.dynamics_ratio} if self.ratio_loss or not self.weighted else set()
        return tuple(key for key in self.bellman_loss._optional_keys() if key not in unread)

    def _written_keys(self) -> Iterable[NestedKey]:
        yield from ("loss_actor", "loss_qvalue")
        if self.value_loss is not None:
            yield "loss_value"
        yield "loss_alpha"
        if self.cloning is not None:
            yield "loss_cloning"
        if self.ratio_loss is not None:
            yield from self.ratio_loss.out_keys
            if self.weighted:
                yield from ("dynamics_ratio", "unclamped_ratio")
        if self.reduction != "none":
            if self.ratio_loss is not None and self.weighted:
                yield "effective_sample_size"
            yield from ("alpha", "entropy")

    @dispatch(source="_dispatch_keys")
    def forward(self, tensordict: TensorDictBase, pairs: TensorDictBase | None = None) -> TensorDictBase:
        """Compute all losses.

        Args:
            tensordict: transitions of both streams, ``[*B]``. Its td error is written into it.
            pairs: transitions for the discriminators, ``[*C]``. Defaults to ``tensordict``.
        """
        bellman, batch = self.bellman_loss, self._without_masked_rows(tensordict).copy()
        rows = bellman._rows(batch)
        ratio_terms = self._ratio_terms(batch, rows, pairs)
        loss_qvalue = bellman.qvalue_loss(batch, rows)
        tensordict.set(self.tensor_keys.priority, batch.get(self.tensor_keys.priority))
        value_terms = self._value_terms(batch, rows)
        actor_terms, log_prob = self.actor_terms(batch, rows)
        terms = {
            **actor_terms,
            "loss_qvalue": loss_qvalue,
            **value_terms,
            "loss_alpha": self.alpha_loss(log_prob, rows),
            **ratio_terms,
        }
        if self.reduction != "none":
            terms |= {"alpha": self.alpha, "entropy": self._metric(-log_prob, rows)}
        return self._output(terms, tensordict)

    def _ratio_terms(self, batch: TensorDictBase, rows: Rows, pairs: TensorDictBase | None) -> dict[str, Tensor]:
        """Compute the discriminators' losses, Eq. (9), and write the ratio into the batch."""
        key = self.tensor_keys.dynamics_ratio
        if self.ratio_loss is None and pairs is not None:
            raise ValueError("pairs train the discriminators, and this loss has none: pass a ratio_loss.")
        if not self.weighted and batch.get(key, None) is not None:
            batch.del_(key)
        if self.ratio_loss is None:
            return {}
        if pairs is not None and self.reduction == "none":
            raise ValueError(
                "with reduction='none' a loss has one term per row of the batch, and pairs are other rows: call "
                "loss.ratio_loss(pairs) by itself."
            )
        terms = dict(self.ratio_loss(batch if pairs is None else pairs).items())
        if self.weighted:
            log_ratio, ratio = self.ratio_loss.log_and_clamped_ratio(batch)
            batch.set(key, ratio)
            terms |= self._ratio_figures(log_ratio, ratio, rows)
        return terms

    def _ratio_figures(self, log_ratio: Tensor, ratio: Tensor, rows: Rows) -> dict[str, Tensor]:
        """Compute the logged values of the ratio of the simulated rows."""
        if self.reduction == "none":
            return {"dynamics_ratio": ratio, "unclamped_ratio": log_ratio.exp()}

        def mean_of_sim(values: Tensor) -> Tensor:
            return self._expectation(values, rows, "sim", reduction="mean", prioritised=False)

        mean, mean_square = mean_of_sim(ratio), mean_of_sim(ratio.square())
        return {
            "dynamics_ratio": mean,
            "unclamped_ratio": mean_of_sim(log_ratio.exp()),
            # 0 without simulated rows
            "effective_sample_size": mean.square() / torch.where(mean_square > 0, mean_square, 1.0),
        }

    def _value_terms(self, batch: TensorDictBase, rows: Rows) -> dict[str, Tensor]:
        """Compute the loss of V, Eq. (4): regress V on the target Q at the actions in the data."""
        value_loss, bellman = self.value_loss, self.bellman_loss
        if value_loss is None:
            return {}
        with torch.no_grad():
            qvalue = bellman.qvalues(batch, bellman.target_qvalue_network_params).amin(0)
        batch.set(value_loss.tensor_keys.state_action_value, qvalue)
        return {"loss_value": value_loss.value_loss(batch, rows)}

    def actor_terms(self, tensordict: TensorDictBase, rows: Rows) -> tuple[dict[str, Tensor], Tensor]:
        """Compute the policy's reduced losses, and log π(a|s) of the sampled actions as a constant, ``[*B]``."""
        bellman, states, key = self.bellman_loss, tensordict.copy(), self.tensor_keys.action
        action, log_prob = bellman.sample_action(states)
        states.set(key, action)
        qvalue = bellman.qvalues(states, self.qvalue_network_params, frozen=True).amin(0)
        terms = {"loss_actor": self._union_expectation(self.alpha * log_prob - qvalue, rows)}  # Eq. (10)
        if self.cloning is not None:
            size = self._union_expectation(qvalue.detach().abs(), rows, "mean", prioritised=False)
            distance = (action - tensordict.get(key)).square().mean(-1)
            terms = {
                "loss_actor": self.cloning / size * terms["loss_actor"],
                "loss_cloning": self._expectation(distance, rows, "real"),
            }
        return terms, log_prob.detach()

    def alpha_loss(self, log_prob: Tensor, rows: Rows) -> Tensor:
        """Compute SAC's reduced loss of β; a gradient step raises β while the entropy is below its target."""
        terms = -self.log_alpha * (log_prob + self.target_entropy)
        return self._union_expectation(terms, rows)


def _check_shared_value(bellman_loss: MixedBellmanLoss, value_loss: InSampleValueLoss | None) -> None:
    """Check that both losses use the same V, or that neither uses one."""
    read = None if bellman_loss.value_network is None else bellman_loss.value_network_params
    trained = None if value_loss is None else value_loss.value_network_params
    if read is None and trained is None:
        return
    if read is None or trained is None or not _are_shared(read, trained):
        raise ValueError(
            "bellman_loss reads one value network and value_loss trains it, so both are built from the same module: "
            "MixedBellmanLoss(actor, qvalues, value, ...) and, for example, ExpectileValueLoss(value). Without V "
            "leave it out of both, with mixing=0.0."
        )


def _are_shared(params: TensorDictBase, others: TensorDictBase) -> bool:
    keys = set(params.keys(True, True))
    pairs = [(params.get(key), others.get(key, None)) for key in keys]
    # Parameters are the same objects; of a buffer, each loss holds another view.
    return keys == set(others.keys(True, True)) and all(
        one is other or (not is_lazy(one) and one.data_ptr() == other.data_ptr()) for one, other in pairs
    )
