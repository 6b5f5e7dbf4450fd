import pytest
import torch
from torchrl.envs import DoubleToFloat, EnvBase, GymEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_h2o.envs import ActionHistory, BatchedMujocoEnv


def hopper(worlds: int | None = None, N: int = 2) -> EnvBase:  # noqa: N803
    env = GymEnv("Hopper-v5")
    env = env if worlds is None else BatchedMujocoEnv(env, worlds)
    return TransformedEnv(env, DoubleToFloat()).append_transform(ActionHistory(N))


@pytest.mark.parametrize("worlds", [None, 3])
def test_the_observation_begins_with_the_last_actions(worlds):
    env = hopper(worlds)
    check_env_specs(env)
    steps = env.rollout(4)
    action, shown = steps["action"], steps["next", "observation"]
    assert shown.shape[-1] == 2 * 3 + 11
    torch.testing.assert_close(shown[..., 3, :6], torch.cat([action[..., 2, :], action[..., 3, :]], -1))
    assert not steps["observation"][..., 0, :6].any()  # no action yet
    assert not shown[..., 0, :3].any()
    torch.testing.assert_close(shown[..., :-1, :], steps["observation"][..., 1:, :])


def test_worlds_that_end_at_different_steps_begin_with_histories_of_their_own():
    env = hopper(worlds=4, N=3)
    env.set_seed(0)
    torch.manual_seed(0)
    steps = env.rollout(60, break_when_any_done=False)
    done = steps["next", "done"].squeeze(-1)
    ends = [row.nonzero().flatten().tolist() for row in done]
    assert len({tuple(row) for row in ends}) > 1
    for world, row in enumerate(ends):
        recorded = steps[world].exclude("observation", ("next", "observation"))
        recorded["observation"] = steps[world]["observation"][:, 9:]
        recorded["next", "observation"] = steps[world]["next", "observation"][:, 9:]
        shown = ActionHistory(3).unfolding(recorded)
        for end in row[:-1]:
            assert not shown["observation"][end + 1, :9].any()
        for key in ("observation", ("next", "observation")):  # as in the environment, after every reset
            torch.testing.assert_close(shown[key], steps[world][key])
        assert recorded["observation"].shape[-1] == 11


def test_a_history_without_actions_is_refused():
    with pytest.raises(ValueError, match="at least one action"):
        ActionHistory(0)


def test_a_transform_outside_of_an_env_says_where_it_belongs():
    reset = GymEnv("Hopper-v5").reset()
    with pytest.raises(RuntimeError, match="belongs in a TransformedEnv"):
        ActionHistory(2)._reset(reset, reset)
