"""Pairs of a real and a simulated transition: the same (s, a), another s'."""

import pytest
import torch
from tensordict import TensorDict

from torchrl_h2o.data import PairedTransitions


def transitions(rows=20):
    number = torch.arange(rows, dtype=torch.float32)[:, None]
    return TensorDict(
        observation=number, action=10 * number, next=TensorDict(observation=number + 0.25), batch_size=rows
    ).auto_batch_size_(1)


def test_both_streams_have_the_same_states_and_actions_and_their_own_next_state():
    real = transitions()
    batch = PairedTransitions(real, real["observation"] + 0.5).sample((6, 4))
    assert batch["real"].tolist() == [True] * 6 + [False] * 4
    assert (batch["observation"][:4] == batch["observation"][6:]).all()
    assert (batch["action"] == 10 * batch["observation"]).all()
    change = batch["next", "observation"] - batch["observation"]
    assert change.flatten().tolist() == [0.25] * 6 + [0.5] * 4


def test_rows_that_cannot_be_simulated_are_in_neither_stream():
    real = transitions()
    following = torch.where(real["observation"] < 15, torch.nan, real["observation"])
    pairs = PairedTransitions(real, following)
    assert len(pairs) == 5
    batch = pairs.sample((50, 50))
    assert batch["observation"].min() >= 15
    with pytest.raises(ValueError, match="none of the rows"):
        PairedTransitions(real, torch.full_like(following, torch.nan))


def test_a_generator_repeats_its_rows():
    pairs = PairedTransitions(transitions(), torch.zeros(20, 1))
    one, other = (pairs.sample((5, 5), torch.Generator().manual_seed(3)) for _ in range(2))
    assert (one == other).all()


def test_the_next_state_can_have_another_key():
    real = transitions()
    real["next", "original_observation"] = real["next", "observation"]
    key = ("next", "original_observation")
    batch = PairedTransitions(real, torch.zeros(20, 1), next_observation=key).sample((2, 2))
    assert ("next", "observation") not in batch.keys(True)
    assert batch[key][2:].tolist() == [[0.0], [0.0]]
