"""Members of a population learn as single runs do, with random numbers of their own."""

import pytest
import torch
from torch import nn
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

from tests.objectives.conftest import ACTION_DIM, OBSERVATION_DIM, Parts, make_batch
from tests.training.fixed_numbers import FixedNumbers
from torchrl_h2o.objectives import (
    DynamicsRatioLoss,
    ExpectileValueLoss,
    ExponentialValueLoss,
    H2OPlusLoss,
    MixedBellmanLoss,
    SparseValueLoss,
    total_loss,
)
from torchrl_h2o.training.populations import Population

LR, TAU = 3e-3, 0.05


class Randomly(nn.Module):
    def __init__(self, function):
        super().__init__()
        self.function = function

    def forward(self, batch):
        return {"drawn": self.function(batch["observation"])}


class Run(nn.Module):
    """One run as in a user's script: H2O+'s loss, and the discriminators' loss on a separate batch."""

    def __init__(self, seed, value_loss=ExpectileValueLoss):
        super().__init__()
        parts = Parts(seed, torch.float32)
        self.loss = parts.h2o_plus(value_loss, ratio=False, mixing=0.1 + 0.3 * seed)
        self.ratio_loss = DynamicsRatioLoss(parts.estimator)
        self.__dict__["targets"] = SoftUpdate(self.loss, tau=TAU)
        self.__dict__["optimiser"] = torch.optim.Adam(self.parameters(), lr=LR, fused=True)

    def forward(self, batch, pairs):
        terms = self.ratio_loss(pairs)
        batch.set("dynamics_ratio", self.ratio_loss.dynamics_ratio(batch))
        return self.loss(batch).update(terms)

    def update(self, batch, pairs):
        terms = self(batch, pairs)
        self.optimiser.zero_grad()
        total_loss(terms).backward()
        self.optimiser.step()
        self.targets.step()
        return terms


def batches(member, update):
    seed = 1000 * member + 2 * update
    return [make_batch(4, 4, seed, torch.float32), make_batch(6, 6, seed + 1, torch.float32)]


def stacked_batches(runs, update):
    together = zip(*(batches(i, update) for i in range(len(runs))), strict=True)
    return [torch.stack(list(same)) for same in together]


def train_together(runs, updates, spoil=lambda update, stacked: None):
    """Trains runs as a population; returns the terms of every update, the stopped members, and the population."""
    population, stopped, history = Population(runs), set(), []
    optimiser = torch.optim.Adam(population.parameters(), lr=LR, fused=True)
    torch.manual_seed(0)
    for update in range(updates):
        stacked = stacked_batches(runs, update)
        spoil(update, stacked)
        terms = population(*stacked)
        optimiser.zero_grad()
        total_loss(terms).sum().backward()
        stopped |= set((~total_loss(terms).isfinite()).nonzero().flatten().tolist())
        for member in stopped:
            population.stop(member, optimiser)
        optimiser.step()
        population.move_targets(TAU)
        history.append({name: term.detach() for name, term in terms.items()})
    return history, stopped, population


def numbers(run):
    return {name: tensor.clone() for name, tensor in run.state_dict().items() if isinstance(tensor, torch.Tensor)}


@pytest.mark.parametrize("value_loss", [ExpectileValueLoss, SparseValueLoss, ExponentialValueLoss])
def test_without_random_numbers_members_learn_what_single_runs_learn(value_loss):
    alone, together = ([Run(seed, value_loss) for seed in range(3)] for _ in range(2))
    with FixedNumbers():
        for update in range(5):
            for member, run in enumerate(alone):
                run.update(*batches(member, update))
        train_together(together, 5)
    for member in range(3):
        before = Run(member, value_loss).state_dict()
        for name, tensor in numbers(alone[member]).items():
            torch.testing.assert_close(numbers(together[member])[name], tensor, rtol=1e-5, atol=1e-5)
            if name.endswith("weight"):
                assert (tensor - before[name]).abs().max() > 1e-4, name  # far beyond rounding


def test_members_draw_numbers_of_their_own_that_are_distributed_as_those_of_a_single_run():
    runs = [Randomly(lambda x: x + torch.distributions.Normal(0.0, 1.0).rsample(x.shape)) for _ in range(3)]
    population, batch = Population(runs), torch.stack([make_batch(2000, 2000, 0, torch.float32)] * 3)
    torch.manual_seed(0)
    drawn = population(batch)["drawn"] - batch["observation"]
    assert drawn.mean((1, 2)).abs().max() < 0.03
    assert (drawn.std((1, 2)) - 1.0).abs().max() < 0.03
    assert torch.corrcoef(drawn.flatten(1)).fill_diagonal_(0.0).abs().max() < 0.03
    torch.manual_seed(0)
    assert torch.equal(population(batch)["drawn"] - batch["observation"], drawn)


def test_a_member_keeps_a_lambda_of_its_own():
    runs = [Run(seed) for seed in range(2)]
    population = Population(runs)
    assert population.stacked["loss", "bellman_loss", "mixing"].tolist() == pytest.approx([0.1, 0.4])
    runs[1].loss.mixing = 0.7
    assert population.stacked["loss", "bellman_loss", "mixing"].tolist() == pytest.approx([0.1, 0.7])


def test_a_member_s_policy_acts_with_what_the_population_has_learnt():
    parts = Parts(0, torch.float32)
    loss = parts.h2o_plus()
    population = Population([loss, Parts(1, torch.float32).h2o_plus()])
    before = parts.actor(observation=torch.ones(3))[0].detach()
    with torch.no_grad():
        for parameter in population.parameters():
            parameter.add_(0.1)
    assert (parts.actor(observation=torch.ones(3))[0] - before).abs().max() > 0.01


def spoiled(update, stacked):
    if update == 5:
        stacked[0]["next", "reward"][1] = float("nan")


def test_a_member_that_fails_stops_and_leaves_the_others_exactly_as_they_were():
    healthy, broken, until_then = ([Run(seed) for seed in range(3)] for _ in range(3))
    train_together(healthy, 10)
    history, stopped, population = train_together(broken, 10, spoiled)
    train_together(until_then, 5)
    assert stopped == {1}
    assert history[5]["loss_qvalue"].isnan().tolist() == [False, True, False]
    assert population.finite().all()
    for member in (0, 2):
        assert all((numbers(broken[member])[k] == v).all() for k, v in numbers(healthy[member]).items())
    online = {k: v for k, v in numbers(until_then[1]).items() if "target" not in k}
    assert all((numbers(broken[1])[k] == v).all() for k, v in online.items())


def test_a_member_whose_parameters_are_no_numbers_is_found():
    population = Population([Run(seed) for seed in range(3)])
    with torch.no_grad():
        next(population.parameters())[1].view(-1)[0] = float("nan")
    assert population.finite().tolist() == [True, False, True]
    terms = population(*stacked_batches(population.members, 0))
    assert total_loss(terms).isfinite().tolist() == [True, False, True]


def test_members_of_unequal_shapes_are_refused():
    other = Parts(1, torch.float32)
    with pytest.raises(ValueError, match="member 1 and member 0 of a population differ in"):
        Population([Parts(0, torch.float32).h2o_plus(), other.h2o_plus(ratio=False)])
    with pytest.raises(ValueError, match="at least one member"):
        Population([])


def layer_norm_loss(seed):
    parts = Parts(seed, torch.float32)
    inputs = OBSERVATION_DIM + ACTION_DIM
    sizes = {"norm_class": nn.LayerNorm, "norm_kwargs": {"normalized_shape": 8}}
    qvalues = [
        ValueOperator(MLP(inputs, 1, num_cells=[8, 8], **sizes), in_keys=["observation", "action"]) for _ in range(2)
    ]
    bellman_loss = MixedBellmanLoss(parts.actor, qvalues, parts.value)
    return H2OPlusLoss(bellman_loss, ExpectileValueLoss(parts.value), DynamicsRatioLoss(parts.estimator))


def sac_loss(seed):
    parts = Parts(seed, torch.float32)
    return SACLoss(parts.actor, parts.qvalues)


@pytest.mark.parametrize("make", [layer_norm_loss, sac_loss])
def test_members_may_be_any_loss_of_any_network(make):
    """Without random numbers in its target and its policy, a member's loss is that of a single run."""
    alone, together = ([make(seed) for seed in range(3)] for _ in range(2))
    population = Population(together)
    batch = torch.stack([make_batch(4, 4, member, torch.float32) for member in range(3)])
    with FixedNumbers():
        terms = population(batch.copy())
        total_loss(terms).sum().backward()
        stacks = {name.removeprefix("stacked."): p.grad for name, p in population.named_parameters()}
        for member, loss in enumerate(alone):
            expected = loss(batch[member].copy())
            for name, term in expected.items():
                torch.testing.assert_close(terms[name][member], term, rtol=1e-5, atol=1e-5)
            total_loss(expected).backward()
            for name, parameter in loss.named_parameters():
                torch.testing.assert_close(stacks[name][member], parameter.grad, rtol=1e-4, atol=1e-5)


def test_a_network_that_two_losses_share_is_stacked_once():
    runs = [Parts(seed, torch.float32).h2o_plus() for seed in range(2)]
    population = Population(runs)
    assert len(list(population.parameters())) == len(list(runs[0].parameters()))
    read, trained = (population.stacked.get((name, "value_network_params")) for name in ("bellman_loss", "value_loss"))
    assert all(read.get(key) is trained.get(key) for key in read.keys(True, True))
