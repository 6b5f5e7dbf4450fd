"""What CUDA graphs need of an update, on any machine: a graph reads the tensors that it was captured with."""

import pytest
import torch
from torch.optim.lr_scheduler import LinearLR
from torchrl.data import Bounded

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.training import cuda_graph
from torchrl_h2o.training.cuda_graph import fit_to_device
from torchrl_h2o.training.methods import METHODS
from torchrl_h2o.training.populations import PopulationReplay
from torchrl_h2o.training.populations.learner import PopulationLearner


@pytest.mark.parametrize("name", list(METHODS))
def test_an_update_leaves_its_batches_as_they_are(compose, monkeypatch, name):
    kept = []

    def watching(function, device):
        def call(*batches):
            before = [dict(batch.items(True, True)) for batch in batches]
            result = function(*batches)
            after = [dict(batch.items(True, True)) for batch in batches]
            kept.append(
                all(now[key] is tensor for now, then in zip(after, before, strict=True) for key, tensor in then.items())
            )
            return result

        return call

    monkeypatch.setattr(cuda_graph, "CudaGraphModule", watching)
    cfg, real = compose("n_steps=1")
    replay = HybridReplayBuffer(real, sim_capacity=len(real), batch_size=cfg.batch_size)
    replay.extend(real)
    learner = METHODS[name].make_learner(cfg, 4, Bounded(-1.0, 1.0, (1,)), replay)
    learner.use_cuda_graphs()
    assert not any(term.requires_grad for term in learner.update().values())
    assert kept == [True]


def test_an_optimiser_saved_on_a_gpu_goes_on_with_numbers_on_a_cpu():
    weight = torch.nn.Parameter(torch.ones(2))
    optimiser = torch.optim.Adam([weight], lr=0.1, fused=True)
    schedule = LinearLR(optimiser, 1.0, 0.0, total_iters=2)
    optimiser.param_groups[0].update(capturable=True, lr=torch.tensor(0.1))
    fit_to_device(optimiser, torch.device("cpu"))
    for _ in range(2):
        optimiser.zero_grad()
        weight.sum().backward()
        optimiser.step()
        schedule.step()
    torch.testing.assert_close(weight.detach(), torch.full((2,), 1 - 0.1 - 0.05))
    assert optimiser.param_groups[0]["lr"] == 0.0


def test_a_replayed_graph_draws_from_buffers_that_have_grown(compose, monkeypatch):
    def replaying(function, device):
        first = []

        def call():  # runs the Python code once, as a graph does
            first[:] = first or [function()]
            return first[0]

        return call

    monkeypatch.setattr(cuda_graph, "CudaGraphModule", replaying)
    cfg, real = compose("n_steps=1")
    replay = PopulationReplay(real, 2 * len(real), cfg.batch_size, 2)
    for buffer in replay.buffers:
        buffer.extend(real)
    make = METHODS["h2o_plus"].make_learner
    spec = Bounded(-1.0, 1.0, (1,))
    population = PopulationLearner([make(cfg, 4, spec, buffer) for buffer in replay.buffers], replay, cfg.lr, cfg.tau)
    population.use_cuda_graphs()
    population.update()
    replay.buffers[1].extend(real)
    population.update()
    assert replay._lengths[1].flatten().tolist() == [len(real), 2 * len(real)]
