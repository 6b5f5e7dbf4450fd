"""Training on a GPU: the same losses as on the CPU, and whole runs. Skipped on machines without one."""

import pickle

import pytest
import torch
from omegaconf import OmegaConf
from torch.optim.lr_scheduler import LinearLR
from torchrl.data import Bounded

from tests.small_runs import interrupt_at, rows
from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.objectives import total_loss
from torchrl_h2o.training.cuda_graph import fit_to_device
from torchrl_h2o.training.environments import make_reality
from torchrl_h2o.training.loop import train
from torchrl_h2o.training.methods import METHODS, h2o_plus
from torchrl_h2o.training.populations import Population, PopulationReplay
from torchrl_h2o.training.populations.learner import PopulationLearner
from torchrl_h2o.training.populations.loop import members_of, train_population
from torchrl_h2o.training.progress import Training
from torchrl_h2o.training.returns import TRIAL_SEED, evaluate
from torchrl_h2o.training.trained_policy import load_policy

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="this machine has no CUDA device")


def learner_on(device, cfg, real, seed=0, make_learner=h2o_plus.make_learner):
    """Builds a method, H2O+ by default, on a device, with simulated rows that equal the real ones."""
    replay = HybridReplayBuffer(real, sim_capacity=len(real), batch_size=cfg.batch_size, device=device)
    replay.extend(real)
    with torch.device(device):
        return make_learner(OmegaConf.merge(cfg, {"seed": seed}), 4, Bounded(-1.0, 1.0, (1,)), replay)


def population_of(count, cfg, real):
    """Builds a population of H2O+ on the GPU, with simulated rows that equal the real ones."""
    replay = PopulationReplay(real, len(real), cfg.batch_size, count, device="cuda")
    for buffer in replay.buffers:
        buffer.extend(real)
    with torch.device("cuda"):
        learners = [
            h2o_plus.make_learner(OmegaConf.merge(cfg, {"seed": seed}), 4, Bounded(-1.0, 1.0, (1,)), buffer)
            for seed, buffer in enumerate(replay.buffers)
        ]
    return PopulationLearner(learners, replay, cfg.lr, cfg.tau)


def test_a_gpu_computes_the_losses_and_gradients_of_the_cpu(compose):
    cfg, real = compose()
    on_cpu, on_gpu = ([learner_on(device, cfg, real, seed) for seed in (0, 1)] for device in ("cpu", "cuda"))
    for one, other in zip(on_cpu, on_gpu, strict=True):
        other.losses["loss"].load_state_dict(one.losses["loss"].state_dict())
    batches = [torch.stack(list(both)) for both in zip(*(learner.sample() for learner in on_cpu), strict=True)]
    on_cpu, on_gpu = (Population([learner.terms_of for learner in some]) for some in (on_cpu, on_gpu))
    noise = on_cpu.draw(*batches)
    expected, terms = (
        on_cpu(*batches, noise=noise),
        on_gpu(*(batch.to("cuda") for batch in batches), noise=[numbers.to("cuda") for numbers in noise]),
    )
    assert all(term.device.type == "cuda" for term in terms.values())
    torch.testing.assert_close({name: term.cpu() for name, term in terms.items()}, expected, rtol=1e-4, atol=1e-5)
    for some in (expected, terms):
        total_loss(some).sum().backward()
    for mine, its in zip(on_cpu.parameters(), on_gpu.parameters(), strict=True):
        assert (mine.grad is None) == (its.grad is None)
        if mine.grad is not None:
            torch.testing.assert_close(its.grad.cpu(), mine.grad, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("name", [*METHODS, "a population"])
def test_cuda_graphs_change_the_parameters_as_updates_without_them_do(compose, name):
    cfg, real = compose("n_steps=1")
    results = []
    for graphs in (False, True):
        if name in METHODS:
            learner = learner_on("cuda", cfg, real, make_learner=METHODS[name].make_learner)
            parameters = learner.parameters
        else:
            learner = population_of(3, cfg, real)
            parameters = learner.population.parameters()
        fit_to_device(learner.optimiser, torch.device("cuda"))
        schedule = LinearLR(learner.optimiser, 1.0, 0.1, total_iters=8)
        if graphs:
            learner.use_cuda_graphs()
        torch.manual_seed(1)
        for _ in range(8):
            terms = learner.update()
            schedule.step()
        results.append([*terms.values(), *(parameter.detach().clone() for parameter in parameters)])
    torch.testing.assert_close(results[1], results[0], rtol=1e-4, atol=1e-6)


def test_a_member_that_diverges_is_stopped_and_the_others_go_on(compose):
    cfg, real = compose("n_steps=1")
    learner = population_of(3, cfg, real)
    fit_to_device(learner.optimiser, torch.device("cuda"))
    learner.use_cuda_graphs()
    for update in range(8):
        if update == 5:
            next(iter(learner.population.parameters())).data[1] = torch.nan
        learner.update()
    assert list(learner.failures) == [1]
    assert learner.failures[1]["updates"] == 5
    learner.check_parameters()
    assert list(learner.failures) == [1]


@pytest.mark.parametrize("compiled", ["auto", "false"])
@pytest.mark.parametrize("name", list(METHODS))
def test_every_method_trains_on_a_gpu_and_its_policy_runs_on_the_cpu(compose, tmp_path, name, compiled):
    cfg, real = compose(f"method={name}", "device=cuda", f"compiled={compiled}")
    policy, training = train(METHODS[name], cfg, real, tmp_path)
    assert len(training.rows) == 3
    assert all(parameter.device.type == "cpu" for parameter in policy.parameters())
    assert b"cuda" not in pickle.dumps(policy)  # nothing of it is on the GPU, as bounds of the action could be
    reality = make_reality(cfg, 2)
    loaded = load_policy(cfg, tmp_path, METHODS[name].title)
    assert evaluate(reality, loaded, 2, TRIAL_SEED).mean == evaluate(reality, policy, 2, TRIAL_SEED).mean


def test_an_interrupted_run_goes_on_from_its_checkpoint(compose, tmp_path, monkeypatch):
    cfg, real = compose("device=cuda", "keep=best_in_simulator", "lr_end_factor=0.1")
    monkeypatch.setattr(Training, "evaluate", interrupt_at(epoch=1, evaluate=Training.evaluate))
    with pytest.raises(KeyboardInterrupt):
        train(METHODS["h2o_plus"], cfg, real, tmp_path)
    monkeypatch.undo()
    policy, training = train(METHODS["h2o_plus"], cfg, real, tmp_path)
    assert training.updates == cfg.updates
    assert [row["updates"] for row in training.rows] == [20, 40, 60]
    assert all(parameter.isfinite().all() for parameter in policy.parameters())


@pytest.mark.parametrize("estimator", ["paper", "pairs"])
def test_a_population_trains_on_a_gpu(compose, tmp_path, estimator):
    cfg, real = compose("seeds=[0,1]", "device=cuda", f"ratio_estimator={estimator}")
    outcomes = train_population(h2o_plus.make_learner, cfg, members_of(cfg), real, tmp_path)
    assert list(outcomes) == ["seed_0", "seed_1"]
    for name, outcome in outcomes.items():
        assert outcome.failure is None
        assert outcome.updates == cfg.updates
        assert len(rows(tmp_path / name)) == 3
        assert all(parameter.device.type == "cpu" for parameter in outcome.policy.parameters())
        load_policy(members_of(cfg)[name], tmp_path / name)
    first, second = (torch.cat([p.flatten() for p in one.policy.parameters()]) for one in outcomes.values())
    assert not torch.equal(first, second)
