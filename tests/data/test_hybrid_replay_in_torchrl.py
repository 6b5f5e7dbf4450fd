"""HybridReplayBuffer as a TorchRL replay buffer: collectors, trainers, transforms and samplers."""

import numpy as np
import pytest
import torch
from torchrl.collectors import Collector
from torchrl.data import Bounded, PrioritizedSampler, ReplayBuffer
from torchrl.data.replay_buffers import SamplerWithoutReplacement
from torchrl.envs import DoubleToFloat, GymEnv, RewardScaling, TransformedEnv
from torchrl.objectives import SoftUpdate
from torchrl.trainers import ReplayBufferTrainer, Trainer
from torchrl.trainers.algorithms import SACTrainer

from tests.data.recordings import assert_same
from tests.data.test_hybrid_replay import make_buffer, stream
from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.objectives import (
    DynamicsRatioLoss,
    ExpectileValueLoss,
    H2OPlusLoss,
    MixedBellmanLoss,
    make_actor,
    make_dynamics_ratio_estimator,
    make_qvalue,
    make_value,
    total_loss,
)


def prioritised(capacity):
    """TorchRL's prioritised sampler, or the reason why this installation of TorchRL has none."""
    try:
        return PrioritizedSampler(capacity, alpha=1.0, beta=0.5)
    except RuntimeError as error:  # TorchRL raises it where its C++ extension is of another torch
        pytest.skip(f"torchrl's C++ extension does not load with torch {torch.__version__}: {error}")


def h2o_plus(observations, spec):
    cells, actions = (8,), spec.shape[-1]
    actor, value = make_actor(observations, spec, cells), make_value(observations, cells)
    bellman = MixedBellmanLoss(actor, make_qvalue(observations, actions, cells, ensemble=2), value)
    ratio = DynamicsRatioLoss(make_dynamics_ratio_estimator(observations, actions, cells))
    return H2OPlusLoss(bellman, ExpectileValueLoss(value), ratio)


@pytest.fixture
def pendulum():
    torch.manual_seed(0)
    env = TransformedEnv(GymEnv("InvertedPendulum-v5"), DoubleToFloat())
    return env, HybridReplayBuffer(env.rollout(30, break_when_any_done=False), sim_capacity=100, batch_size=(6, 2))


def test_it_is_a_replay_buffer_of_its_simulated_rows():
    buffer = make_buffer(sim=7)
    assert isinstance(buffer, ReplayBuffer)
    assert len(buffer.storage) == buffer.write_count == 7
    assert (buffer[:]["observation"] >= 1000).all()
    buffer.empty()
    assert len(buffer) == 20


@pytest.mark.parametrize(("rows", "real"), [(13, 8), (26, 16), (5, 3), (1, 1)])
def test_a_number_of_rows_is_split_in_the_proportion_of_the_buffer(rows, real):
    batch = make_buffer().sample(rows)
    assert batch["real"].tolist() == [True] * real + [False] * (rows - real)


def test_iteration_gives_batches():
    batches = iter(make_buffer())
    assert [next(batches)["real"].sum().item() for _ in range(3)] == [8, 8, 8]


def test_single_transitions_are_added():
    buffer = make_buffer(sim=0)
    for row in stream(3, offset=1000):
        buffer.add(row)
    assert buffer.sample((0, 50))["next", "reward"].unique().tolist() == [1000, 1001, 1002]


def test_extending_returns_the_places_of_the_rows():
    buffer = make_buffer(capacity=5, sim=0)
    assert buffer.extend(stream(4)).tolist() == [0, 1, 2, 3]
    assert buffer.extend(stream(2)).tolist() == [4, 0]


def test_transforms_alter_batches_and_incoming_simulated_rows():
    buffer = make_buffer(sim=0)
    buffer.append_transform(RewardScaling(loc=0.0, scale=2.0, in_keys=[("next", "reward")]))
    buffer.append_transform(lambda batch: batch.set("twice", 2 * batch["observation"]))
    buffer.extend(stream(3, offset=1000))
    batch = buffer.sample()
    assert torch.equal(batch["twice"], 2 * batch["observation"])
    assert torch.equal(batch["next", "reward"], 2 * batch["observation"][:, :1])


def test_a_collector_fills_it(pendulum):
    env, buffer = pendulum
    collector = Collector(env, None, frames_per_batch=20, total_frames=40, replay_buffer=buffer)
    for _ in collector:
        pass
    collector.shutdown()
    assert len(buffer) == 30 + 40
    assert buffer.sample()["real"].sum() == 6


def test_a_trainer_learns_from_it(pendulum):
    env, buffer = pendulum
    loss = h2o_plus(4, env.action_spec)
    collector = Collector(env, loss.actor_network, frames_per_batch=20, total_frames=40)
    trainer = Trainer(
        collector=collector,
        total_frames=40,
        frame_skip=1,
        optim_steps_per_batch=2,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), 1e-3),
        progress_bar=False,
    )
    ReplayBufferTrainer(buffer, batch_size=8).register(trainer)
    seen = []
    trainer.register_op("post_loss", lambda batch: (seen.append(batch["real"].sum().item()), batch)[1])
    trainer.train()
    assert len(buffer) == 30 + 40
    assert seen == [6] * 4


def test_torchrl_s_sac_trainer_learns_from_it(pendulum):
    env, buffer = pendulum
    loss = h2o_plus(4, env.action_spec)
    before = [parameter.detach().clone() for parameter in loss.parameters()]
    trainer = SACTrainer(
        collector=Collector(env, loss.actor_network, frames_per_batch=20, total_frames=40),
        total_frames=40,
        frame_skip=1,
        optim_steps_per_batch=2,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), 1e-3),
        replay_buffer=buffer,
        target_net_updater=SoftUpdate(loss, tau=0.01),
        progress_bar=False,
        enable_logging=False,
    )
    trainer.train()
    assert len(buffer) == 30 + 40
    assert any(not torch.equal(old, new) for old, new in zip(before, loss.parameters(), strict=True))


def test_a_sampler_of_torchrl_draws_the_rows_of_its_stream():
    buffer = make_buffer(sampler=SamplerWithoutReplacement(), sim=30)
    batch = buffer.sample((4, 30))
    assert sorted(batch["next", "reward"][4:].flatten().tolist()) == list(range(1000, 1030))
    assert torch.equal(batch["next", "reward"][:, 0], batch["index"] + 1000 * ~batch["real"])
    assert (batch["priority_weight"] == 1).all()


def test_priorities_choose_rows_in_both_streams_and_correct_the_loss():
    torch.manual_seed(0)
    buffer = HybridReplayBuffer(
        stream(20), 50, (40, 40), sampler=prioritised(50), real_sampler=prioritised(20), priority_key="td_error"
    )
    buffer.extend(stream(30, offset=1000))
    everything = buffer.sample((400, 400))
    chosen = (everything["index"] == 3) | (everything["index"] == 11)
    everything["td_error"] = chosen.double()
    buffer.update_tensordict_priority(everything)
    batch = buffer.sample()
    assert set(batch["next", "reward"].flatten().tolist()) == {3, 11, 1003, 1011}

    assert ((batch["priority_weight"] > 0) & (batch["priority_weight"] <= 1)).all()

    # the weights reach the losses, whose errors become the next priorities
    loss = h2o_plus(3, Bounded(-1.0, 1.0, (2,)))

    def loss_qvalue(weights):
        torch.manual_seed(0)  # of the next actions
        return loss(batch.clone().set("priority_weight", weights))["loss_qvalue"]

    first = batch["next", "reward"][:, 0] % 1000 == 3
    assert loss_qvalue(torch.where(first, 0.01, 1.0)) > loss_qvalue(torch.where(first, 1.0, 0.01))
    total_loss(loss(batch)).backward()
    assert batch["td_error"].shape[0] == 80
    buffer.update_tensordict_priority(batch)
    assert buffer.sample().shape == (80,)


def test_priorities_are_part_of_a_checkpoint(tmp_path):
    def new():
        return make_buffer(sampler=prioritised(50), sim=30)

    buffer, other = new(), new()
    batch = buffer.sample((5, 200))
    batch["td_error"] = ((batch["index"] == 3) | (batch["index"] == 7)).float()
    buffer.update_tensordict_priority(batch)
    buffer.dumps(tmp_path / "checkpoint")
    other.loads(tmp_path / "checkpoint")

    def drawn(one):
        torch.manual_seed(0)
        np.random.seed(0)  # the generator of TorchRL's sampler
        return one.sample((5, 20))

    assert_same(drawn(other), drawn(buffer))
    assert set(drawn(buffer)["index"][5:].tolist()) <= {3, 7}
