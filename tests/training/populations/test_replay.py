"""Buffers of many runs, sampled together, give each member its own rows."""

import pytest
import torch
from tensordict import TensorDict

from torchrl_h2o.training.populations import PopulationReplay

SIZES = (5, 3)


def transitions(count, seed):
    rng = torch.Generator().manual_seed(seed)
    done = torch.zeros(count, 1, dtype=torch.bool)
    return TensorDict(
        observation=torch.randn(count, 3, generator=rng),
        action=torch.randn(count, 2, generator=rng),
        next=TensorDict(
            observation=torch.randn(count, 3, generator=rng),
            reward=torch.randn(count, 1, generator=rng),
            done=done,
            terminated=done.clone(),
        ),
        batch_size=[count],
    )


@pytest.fixture
def together():
    replay = PopulationReplay(transitions(50, 0), 20, SIZES, 3)
    fill(replay.buffers)
    return replay


def fill(buffers):
    for member, buffer in enumerate(buffers):
        for part in range(1 + 2 * member):
            buffer.extend(transitions(7, 10 * member + part))


def test_each_member_gets_its_own_rows_uniformly(together):
    torch.manual_seed(0)
    batch = together.sample((2000, 2000))
    for member, buffer in enumerate(together.buffers):
        simulated = batch["observation"][member, 2000:]
        own = buffer.storage[:]["observation"]
        seen = (simulated[:, None] == own).all(-1)
        assert seen.any(-1).all()
        expected = 2000 / len(own)
        assert (seen.sum(0) - expected).abs().max() < 6 * expected**0.5
    assert batch["real"].sum(-1).tolist() == [2000] * 3


def sample(replay):
    torch.manual_seed(3)
    return replay.sample()


def test_a_member_goes_on_from_a_checkpoint_of_its_own(together):
    state = together.buffers[1].state_dict()
    before = sample(together)
    together.buffers[1].extend(transitions(9, 99))
    assert (sample(together) != before).any()
    together.buffers[1].load_state_dict(state)
    assert (sample(together) == before).all()


def test_a_member_without_simulated_rows_is_named():
    replay = PopulationReplay(transitions(50, 0), 20, SIZES, 2)
    replay.buffers[0].extend(transitions(7, 1))
    with pytest.raises(RuntimeError, match="member 1 has no simulated transitions yet"):
        replay.sample()
    assert replay.sample((4, 0)).batch_size == torch.Size([2, 4])
