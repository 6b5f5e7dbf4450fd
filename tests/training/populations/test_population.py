"""A population's members learn what they would learn alone."""

import pytest
import torch
from torch import nn
from torch.distributions import Gumbel
from torchrl.objectives import SoftUpdate
from torchrl_h2o.objectives.functional import sample_from_noise

from tests.objectives.conftest import Parts, make_batch
from torchrl_h2o.objectives import (
    DynamicsRatioLoss,
    ExpectileValueLoss,
    ExponentialValueLoss,
    H2OPlusLoss,
    SparseValueLoss,
    total_loss,
)
from torchrl_h2o.training.populations import Population

LR, TAU = 3e-3, 0.05


class Run(nn.Module):
    """One run as a user's script has it: H2O+'s loss, and the discriminators' on a batch of their own."""

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


def with_noise(run, member_batches, generator):
    batch, pairs = member_batches
    pairs["noise"] = run.ratio_loss.draw_noise(pairs, generator)
    batch["noise"] = run.loss.draw_noise(batch, generator)
    return batch, pairs


def train_alone(run, member, updates):
    torch.manual_seed(member)
    return [run.update(*batches(member, update)).detach() for update in range(updates)]


def train_together(runs, updates, spoil=lambda update, stacked: None):
    """The terms of every update, and the members that stopped."""
    population, stopped, history = Population(runs), set(), []
    optimiser = torch.optim.Adam(population.parameters(), lr=LR, fused=True)
    generators = [torch.Generator().manual_seed(member) for member in range(len(runs))]
    for update in range(updates):
        drawn = [with_noise(run, batches(i, update), generators[i]) for i, run in enumerate(runs)]
        stacked = [torch.stack(list(same)) for same in zip(*drawn, strict=True)]
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
                assert (tensor - before[name]).abs().max() > 1e-3, name  # everything has moved far beyond rounding


def test_a_member_keeps_a_lambda_of_its_own():
    runs = [Run(seed) for seed in range(2)]
    population = Population(runs)
    assert population.stacked["loss", "mixing"].tolist() == pytest.approx([0.1, 0.4])
    runs[1].loss.mixing.fill_(0.7)
    assert population.stacked["loss", "mixing"].tolist() == pytest.approx([0.1, 0.7])


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
    train_together(runs, 5)
    drawn = [with_noise(run, batches(member, 5), None) for member, run in enumerate(runs)]
    together = Population(runs)(*(torch.stack(list(same)) for same in zip(*drawn, strict=True)))
    for member, run in enumerate(runs):
        for name, term in run(*drawn[member]).items():
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
    drawn = [with_noise(run, batches(i, 0), None) for i, run in enumerate(population.members)]
    terms = population(*(torch.stack(list(same)) for same in zip(*drawn, strict=True)))
    assert total_loss(terms).isfinite().tolist() == [True, False, True]


def test_members_of_unequal_shapes_are_refused():
    other = Parts(1, torch.float32)
    with pytest.raises(ValueError, match="member 1 and member 0 of a population differ in"):
        Population([Parts(0, torch.float32).h2o_plus(), other.h2o_plus(ratio=False)])
    with pytest.raises(ValueError, match="at least one member"):
        Population([])


@pytest.mark.parametrize("ratio", [True, False])
def test_given_noise_is_what_the_generator_would_have_drawn(ratio):
    loss: H2OPlusLoss = Parts(0).h2o_plus(ratio=ratio)
    torch.manual_seed(7)
    drawn = loss(make_batch())
    batch = make_batch()
    batch["noise"] = loss.draw_noise(batch, torch.Generator().manual_seed(7))
    torch.manual_seed(8)
    given = loss(batch)
    assert (given == drawn).all()


def test_noise_is_given_for_gaussian_policies_alone():
    with pytest.raises(TypeError, match="Gumbel"):
        sample_from_noise(Gumbel(torch.zeros(2, 1), torch.ones(2, 1)), torch.zeros(2, 1))


def test_evaluation_mode_draws_no_noise_for_the_discriminators():
    loss = Parts(0).h2o_plus()
    loss.eval()
    assert set(loss.draw_noise(make_batch()).keys()) == {"next_action", "action"}


@pytest.mark.slow
def test_compiled_losses_of_a_population_are_the_eager_ones():
    runs = [Run(seed) for seed in range(2)]
    population = Population(runs)
    drawn = [with_noise(run, batches(i, 0), None) for i, run in enumerate(runs)]
    stacked = [torch.stack(list(same)) for same in zip(*drawn, strict=True)]
    compiled = torch.compile(population, backend="eager", fullgraph=True)
    eager = population(*stacked)
    total_loss(eager).sum().backward()
    expected = [parameter.grad.clone() for parameter in population.parameters()]
    population.zero_grad()
    terms = compiled(*stacked)
    total_loss(terms).sum().backward()
    for name, term in eager.items():
        torch.testing.assert_close(terms[name], term)
    torch.testing.assert_close([parameter.grad for parameter in population.parameters()], expected)
