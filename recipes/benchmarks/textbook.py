"""H2O+ written directly from the formulas: one optimiser per network, one forward pass per term.

The speed of the library's update is compared with this code, which shares nothing with the library.
"""

import copy
from collections.abc import Iterable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

GAMMA, MIXING, EXPECTILE, TAU, LR = 0.99, 0.1, 0.7, 0.005, 3e-4
INPUT_NOISE, LOGIT_BOUND, CLAMP = 0.1, 2.0, (1e-5, 1.0)

Batch = dict[str, Tensor]  # observation, action, reward, terminated, next_observation; rows first


def mlp(inputs: int, outputs: int, width: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, outputs)
    )


class Policy(nn.Module):
    """Tanh-transformed Gaussian policy for actions in [-1, 1]."""

    def __init__(self, observation_dim: int, action_dim: int, width: int) -> None:
        super().__init__()
        self.network = mlp(observation_dim, 2 * action_dim, width)

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        loc, log_std = self.network(observation).chunk(2, -1)
        normal = torch.distributions.Normal(loc, (log_std - 1.0).clamp(-20.0, 2.0).exp())
        before = normal.rsample()
        # log(1 - tanh(u)^2) without cancellation
        log_slope = 2.0 * (torch.log(torch.tensor(2.0)) - before - F.softplus(-2.0 * before))
        return torch.tanh(before), (normal.log_prob(before) - log_slope).sum(-1)


class TextbookH2OPlus:
    """Eqs. (4) and (7) to (10) of H2O+ with the authors' constants."""

    def __init__(self, observation_dim: int, action_dim: int, width: int = 256) -> None:
        pair = observation_dim + action_dim
        self.policy = Policy(observation_dim, action_dim, width)
        self.qvalues = [mlp(pair, 1, width) for _ in range(2)]
        self.targets = [copy.deepcopy(qvalue) for qvalue in self.qvalues]
        self.value = mlp(observation_dim, 1, width)
        self.sa, self.sas = mlp(pair, 2, width), mlp(pair + observation_dim, 2, width)
        self.log_alpha = torch.zeros((), requires_grad=True)
        self.target_entropy = -float(action_dim)
        networks = [self.policy, *self.qvalues, self.value, self.sa, self.sas]
        self.optimisers = {network: torch.optim.Adam(network.parameters(), lr=LR) for network in networks}
        self.alpha_optimiser = torch.optim.Adam([self.log_alpha], lr=LR)

    def update(self, real: Batch, sim: Batch, real_pairs: Batch, sim_pairs: Batch) -> None:
        """One update from batches of both streams and separate batches for the discriminators."""
        self._step([self.sa, self.sas], self._discriminators_loss(real_pairs, sim_pairs))
        alpha = self.log_alpha.detach().exp()
        self._step([self.value], self._value_loss(real))
        ratio = self._ratio(sim)
        real_target, sim_target = self._target(real, alpha), self._target(sim, alpha)
        for qvalue in self.qvalues:
            real_error = _q(qvalue, real) - real_target
            sim_error = _q(qvalue, sim) - sim_target
            self._step([qvalue], (real_error**2).mean() + (ratio * sim_error**2).mean())
        self._policy_step(torch.cat([real["observation"], sim["observation"]]), alpha)
        self._move_targets()

    def _discriminators_loss(self, real: Batch, sim: Batch) -> Tensor:
        total = 0.0
        for label, batch in ((0, real), (1, sim)):
            sa, sas = self._logits({key: x + INPUT_NOISE * torch.randn_like(x) for key, x in batch.items()})
            labels = torch.full((len(sa),), label)
            total = total + F.cross_entropy(sa, labels) + F.cross_entropy(sas + sa.detach(), labels)
        return total

    def _logits(self, batch: Batch) -> tuple[Tensor, Tensor]:
        pair = torch.cat([batch["observation"], batch["action"]], -1)
        triple = torch.cat([pair, batch["next_observation"]], -1)
        return LOGIT_BOUND * torch.tanh(self.sa(pair)), LOGIT_BOUND * torch.tanh(self.sas(triple))

    @torch.no_grad()
    def _ratio(self, batch: Batch) -> Tensor:
        sa, sas = self._logits(batch)
        p_sa, p_sas = F.softmax(sa, -1)[:, 0], F.softmax(sas + sa, -1)[:, 0]
        return (p_sas / (1.0 - p_sas) / (p_sa / (1.0 - p_sa))).clamp(*CLAMP)  # Eq. (9)

    def _value_loss(self, real: Batch) -> Tensor:
        with torch.no_grad():
            qvalue = torch.min(*(_q(target, real) for target in self.targets))
        advantage = qvalue - self.value(real["observation"]).squeeze(-1)
        weight = torch.where(advantage < 0, 1.0 - EXPECTILE, EXPECTILE)
        return (weight * advantage**2).mean()  # Eq. (4)

    @torch.no_grad()
    def _target(self, batch: Batch, alpha: Tensor) -> Tensor:
        state = batch["next_observation"]
        action, log_prob = self.policy(state)
        qvalue = torch.min(*(_q(target, {"observation": state, "action": action}) for target in self.targets))
        explore = qvalue - alpha * log_prob
        value = MIXING * self.value(state).squeeze(-1) + (1.0 - MIXING) * explore
        return batch["reward"] + GAMMA * (1.0 - batch["terminated"]) * value  # Eq. (7)

    def _policy_step(self, state: Tensor, alpha: Tensor) -> None:
        action, log_prob = self.policy(state)
        qvalue = torch.min(*(_q(qvalue, {"observation": state, "action": action}) for qvalue in self.qvalues))
        self._step([self.policy], (alpha * log_prob - qvalue).mean())  # Eq. (10)
        self.alpha_optimiser.zero_grad()
        (-self.log_alpha * (log_prob.detach() + self.target_entropy)).mean().backward()
        self.alpha_optimiser.step()

    def _step(self, networks: Iterable[nn.Module], loss: Tensor) -> None:
        for network in networks:
            self.optimisers[network].zero_grad()
        loss.backward()
        for network in networks:
            self.optimisers[network].step()

    @torch.no_grad()
    def _move_targets(self) -> None:
        for target, qvalue in zip(self.targets, self.qvalues, strict=True):
            for old, new in zip(target.parameters(), qvalue.parameters(), strict=True):
                old.copy_((1.0 - TAU) * old + TAU * new)


def _q(qvalue: nn.Module, batch: Batch) -> Tensor:
    return qvalue(torch.cat([batch["observation"], batch["action"]], -1)).squeeze(-1)
