"""n-step rows: sums, end marks, one-step next states, and the equality of parts and whole."""

from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from tests.data.recordings import assert_same
from torchrl_h2o.data import HybridReplayBuffer, with_next_actions
from torchrl_h2o.data.multi_step import OngoingMultiStep

GAMMA = 0.9


def run(ends, terminated=None, start=0):
    """Returns transitions 0, 1, 2, ... whose reward and states are their number; ``ends`` marks the last of a run."""
    count = len(ends)
    number = torch.arange(start, start + count, dtype=torch.float32)[:, None]
    done = torch.tensor(ends)[:, None]
    terminated = done if terminated is None else torch.tensor(terminated)[:, None]
    following = TensorDict(
        observation=number + 1,
        reward=number.clone(),
        done=done.clone(),
        terminated=terminated.clone(),
        truncated=done & ~terminated,
        batch_size=count,
    )
    return TensorDict(observation=number, action=number.clone(), next=following, batch_size=count)


def expected(data, t, n):
    """Returns reward, next state, terminated and m of one n-step row, by the definition."""
    total, k = 0.0, 0
    while True:
        total += GAMMA**k * data["next", "reward"][t + k].item()
        k += 1
        if k == n or t + k == len(data) or data["next", "done"][t + k - 1]:
            return total, data["next", "observation"][t + k - 1].item(), bool(data["next", "terminated"][t + k - 1]), k


@settings(max_examples=20, deadline=None)
@given(ends=st.lists(st.booleans(), min_size=1, max_size=30), n=st.integers(2, 7))
def test_every_row_sums_the_rewards_up_to_n_steps_or_the_end_of_its_run(ends, n):
    data = run(ends)
    rows = OngoingMultiStep(n, GAMMA).whole(data)
    assert len(rows) == len(data)
    for t, row in enumerate(rows):
        reward, reached, terminated, steps = expected(data, t, n)
        assert row["next", "reward"].item() == pytest.approx(reward, rel=1e-5)
        assert row["next", "observation"].item() == reached
        assert bool(row["next", "terminated"]) == terminated
        assert row["steps_to_next_obs"].item() == steps
        assert row["next", "original_observation"].item() == data["next", "observation"][t].item()
    assert data["next", "done"].flatten().tolist() == ends  # the caller's data stay


def test_a_time_limit_ends_the_sum_and_is_not_a_termination():
    rows = OngoingMultiStep(3, GAMMA).whole(run([False, True, False], terminated=[False, False, False]))
    assert rows["steps_to_next_obs"].flatten().tolist() == [2, 1, 1]
    assert not rows["next", "terminated"].any()


@settings(max_examples=12, deadline=None)
@given(ends=st.lists(st.booleans(), min_size=12, max_size=40), cuts=st.lists(st.integers(1, 39), max_size=5))
def test_a_stream_in_parts_gives_the_rows_of_the_whole(ends, cuts):
    data, n = run(ends), 4
    bounds = [0, *sorted({cut for cut in cuts if cut < len(ends)}), len(ends)]
    stream = OngoingMultiStep(n, GAMMA)
    parts = [stream.transform(data[a:b]) for a, b in pairwise(bounds)]
    rows = torch.cat([part for part in parts if part is not None])
    whole = OngoingMultiStep(n, GAMMA).whole(data)[: len(data) - n]
    for key in whole.keys(True, True):  # TorchRL's sums are rounded differently for different lengths
        torch.testing.assert_close(rows[key], whole[key], rtol=1e-5, atol=1e-5)


def buffer(**kwargs):
    return HybridReplayBuffer(run([False] * 9 + [True]), 100, (6, 6), n_steps=3, gamma=GAMMA, **kwargs)


def test_a_buffer_gives_n_step_rows_of_both_streams_and_names_the_one_step_state():
    replay = buffer()
    replay.extend(torch.stack([run([False] * 8, start=100), run([False] * 8, start=200)]))
    assert len(replay.storage) == 2 * (8 - 3)
    batch = replay.sample()
    assert replay.next_observation == ("next", "original_observation")
    assert (batch["next", "original_observation"] == batch["observation"] + 1).all()
    assert (batch["next", "observation"] == batch["observation"] + batch["steps_to_next_obs"]).all()
    assert (batch["steps_to_next_obs"][6:] == 3).all()
    replay.extend(torch.stack([run([False] * 2, start=108), run([False] * 2, start=208)]))
    assert sorted(replay.storage[:]["observation"].flatten().tolist())[-7:] == [200, 201, 202, 203, 204, 205, 206]


def test_one_step_rows_have_no_further_entries():
    replay = HybridReplayBuffer(run([False, True]), 10, (2, 0))
    assert replay.next_observation == ("next", "observation")
    assert "steps_to_next_obs" not in replay.sample().keys()


@pytest.mark.parametrize("way", ["state_dict", "dumps"])
def test_rows_that_wait_are_part_of_a_checkpoint(tmp_path, way):
    replay, other = buffer(), buffer()
    replay.extend(run([False] * 5, start=100)[None])
    other.extend(run([False] * 7, start=900)[None])  # its content must be discarded
    if way == "dumps":
        replay.dumps(tmp_path / "replay")
        other.loads(tmp_path / "replay")
    else:
        torch.save(replay.state_dict(), tmp_path / "replay.pt")
        other.load_state_dict(torch.load(tmp_path / "replay.pt", weights_only=True))
    for each in (replay, other):
        each.extend(run([False] * 4, start=105)[None])
    assert_same(other.storage[:], replay.storage[:])
    assert len(other.storage) == 6


@pytest.mark.parametrize("n", [1, 3])
def test_the_next_action_is_the_one_in_the_state_that_the_target_reads_and_rows_without_one_are_left_out(n):
    ends = [False, False, False, True, False, False, True, False, False]  # the second run is truncated
    data = run(ends, terminated=[False, False, False, True, False, False, False, False, False])
    rows = data if n == 1 else OngoingMultiStep(n, GAMMA).whole(data)
    kept = with_next_actions(rows)
    goes_on = ~kept["next", "terminated"].flatten()
    # in ``run`` the action in a state has the state's number
    torch.testing.assert_close(kept["next", "action"][goes_on], kept["next", "observation"][goes_on])
    assert kept["action"].flatten().tolist() == ([0, 1, 2, 3, 4, 5, 7] if n == 1 else [0, 1, 2, 3])
    assert ("next", "action") not in rows.keys(True)
