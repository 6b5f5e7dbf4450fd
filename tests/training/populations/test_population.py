"""Members of a population get the same losses and parameters as single runs."""

import pytest
import torch
from torch import nn
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

from tests.objectives.conftest import ACTION_DIM, OBSERVATION_DIM, Parts, make_batch
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


def train_alone(run, member, updates):
    torch.manual_seed(member)
    return [run.update(*batches(member, update)).detach() for update in range(updates)]


def train_together(runs, updates, spoil=lambda update, stacked: None):
    """Trains runs as a population; returns the terms of every update, the stopped members, and the population."""
    population, stopped, history = Population(runs), set(), []
    optimiser = torch.optim.Adam(population.parameters(), lr=LR, fused=True)
    generators = [torch.Generator().manual_seed(member) for member in range(len(runs))]
    for update in range(updates):
        stacked = stacked_batches(runs, update)
        spoil(update, stacked)
        terms = population(*stacked, noise=population.draw(*stacked, generators=generators))
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
def test_members_learn_what_single_runs_learn(value_loss):
    alone, together = ([Run(seed, value_loss) for seed in range(3)] for _ in range(2))
    expected = [train_alone(run, member, 20) for member, run in enumerate(alone)]
    history, _, _ = train_together(together, 20)
    for member in range(3):
        for update in range(20):
            for name, term in expected[member][update].items():
                torch.testing.assert_close(history[update][name][member], term, rtol=1e-5, atol=1e-5)
        before = Run(member, value_loss).state_dict()
        for name, tensor in numbers(alone[member]).items():
            torch.testing.assert_close(numbers(together[member])[name], tensor, rtol=1e-5, atol=1e-5)
            if name.endswith("weight"):
                assert (tensor - before[name]).abs().max() > 1e-3, name  # far beyond rounding


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


def test_a_member_s_own_loss_sees_what_the_population_has_learnt():
    runs = [Run(seed) for seed in range(2)]
    for member, run in enumerate(runs):
        run(*batches(member, 0))
    _, _, population = train_together(runs, 5)
    stacked = stacked_batches(runs, 5)
    generators = [torch.Generator().manual_seed(member) for member in range(2)]
    together = population(*stacked, noise=population.draw(*stacked, generators=generators))
    for member, run in enumerate(runs):
        torch.manual_seed(member)
        for name, term in run(*batches(member, 5)).items():
            torch.testing.assert_close(together[name][member], term)


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


@pytest.mark.slow
def test_compiled_losses_of_a_population_are_the_eager_ones():
    runs = [Run(seed) for seed in range(2)]
    population = Population(runs)
    stacked = stacked_batches(runs, 0)
    noise = population.draw(*stacked)
    compiled = torch.compile(population, backend="eager", fullgraph=True)
    eager = population(*stacked, noise=noise)
    total_loss(eager).sum().backward()
    expected = [parameter.grad.clone() for parameter in population.parameters()]
    population.zero_grad()
    terms = compiled(*stacked, noise=noise)
    total_loss(terms).sum().backward()
    for name, term in eager.items():
        torch.testing.assert_close(terms[name], term)
    torch.testing.assert_close([parameter.grad for parameter in population.parameters()], expected)


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
    alone, together = ([make(seed) for seed in range(3)] for _ in range(2))
    population = Population(together)
    batch = torch.stack([make_batch(4, 4, member, torch.float32) for member in range(3)])
    generators = [torch.Generator().manual_seed(member) for member in range(3)]
    terms = population(batch.copy(), noise=population.draw(batch, generators=generators))
    total_loss(terms).sum().backward()
    for member, loss in enumerate(alone):
        torch.manual_seed(member)
        expected = loss(batch[member].copy())
        for name, term in expected.items():
            torch.testing.assert_close(terms[name][member], term, rtol=1e-5, atol=1e-5)
        total_loss(expected).backward()
        stacks = {name.removeprefix("stacked."): p.grad for name, p in population.named_parameters()}
        for name, parameter in loss.named_parameters():
            torch.testing.assert_close(stacks[name][member], parameter.grad, rtol=1e-4, atol=1e-5)


def test_a_network_that_two_losses_share_is_stacked_once():
    runs = [Parts(seed, torch.float32).h2o_plus() for seed in range(2)]
    population = Population(runs)
    assert len(list(population.parameters())) == len(list(runs[0].parameters()))
    read, trained = (population.stacked.get((name, "value_network_params")) for name in ("bellman_loss", "value_loss"))
    assert all(read.get(key) is trained.get(key) for key in read.keys(True, True))


def test_without_noise_a_population_draws_from_the_global_generator():
    population = Population([Run(seed) for seed in range(2)])
    stacked = stacked_batches(population.members, 0)
    torch.manual_seed(3)
    first = population(*stacked)
    other = population(*stacked)
    torch.manual_seed(3)
    again = population(*stacked)
    assert torch.equal(first["loss_qvalue"], again["loss_qvalue"])
    assert not torch.equal(first["loss_qvalue"], other["loss_qvalue"])


def test_recording_the_draws_leaves_the_random_state_alone():
    population = Population([Run(seed) for seed in range(2)])
    stacked = stacked_batches(population.members, 0)
    before = torch.get_rng_state()
    generators = [torch.Generator().manual_seed(member) for member in range(2)]
    assert len(population.draw(*stacked, generators=generators)) == 5  # three noisy inputs, two actions
    assert torch.equal(torch.get_rng_state(), before)


def test_evaluation_mode_draws_no_noise_for_the_discriminators():
    population = Population([Run(seed) for seed in range(2)])
    for run in population.members:
        run.eval()
    assert len(population.draw(*stacked_batches(population.members, 0))) == 2


class Randomly(nn.Module):
    def __init__(self, function):
        super().__init__()
        self.function = function

    def forward(self, batch):
        return {"loss": self.function(batch["observation"]).sum()}


def filled_twice(x):
    target = torch.empty_like(x)
    target.normal_()
    return target * x


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (nn.functional.dropout, "dropout"),
        (lambda x: x[torch.randperm(len(x))], "randperm"),
        (filled_twice, "in place"),
        (lambda x: x + torch.randn(x.shape, generator=torch.Generator()), "generator of its own"),
    ],
)
def test_draws_that_cannot_be_supplied_are_refused(function, message):
    population = Population([Randomly(function), Randomly(function)])
    batch = torch.stack([make_batch(4, 4, member, torch.float32) for member in range(2)])
    with pytest.raises(NotImplementedError, match=message):
        population(batch)


def test_bounds_and_moments_of_a_draw_are_kept():
    def draws(x):
        uniform = torch.empty_like(x).uniform_(-2.0, 3.0)
        return uniform + torch.normal(x, 0.5) + torch.rand_like(x) + torch.empty_like(x).normal_(1.0, 2.0)

    population = Population([Randomly(draws), Randomly(draws)])
    batch = torch.stack([make_batch(4, 4, member, torch.float32) for member in range(2)])
    generators = [torch.Generator().manual_seed(member) for member in range(2)]
    got = population(batch, noise=population.draw(batch, generators=generators))["loss"]
    for member in range(2):
        torch.manual_seed(member)
        torch.testing.assert_close(got[member], draws(batch[member]["observation"]).sum())
