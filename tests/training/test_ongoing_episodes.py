"""Episodes that go on from epoch to epoch, also in a resumed run."""

import pytest
import torch

from torchrl_h2o.envs import BatchedMujocoEnv
from torchrl_h2o.objectives import make_actor
from torchrl_h2o.training.collection import simulated_transitions
from torchrl_h2o.training.environments import make_simulator
from torchrl_h2o.training.ongoing_episodes import OngoingEpisodes, saves_episodes


@pytest.fixture
def make(compose):
    """Builds a collector of 2 worlds and 8 steps each, with its ongoing episodes."""

    def build(*overrides, worlds=2):
        cfg, _ = compose(*overrides)
        simulator = make_simulator(cfg, worlds)
        torch.manual_seed(0)
        observation_dim = simulator.observation_spec["observation"].shape[-1]
        actor = make_actor(observation_dim, simulator.action_spec_unbatched, [8, 8])
        collector = simulated_transitions(simulator, actor, 16)
        return iter(collector), OngoingEpisodes(collector)

    return build


def collect(rollouts, episodes, epoch):
    torch.manual_seed(epoch)
    episodes.begin_epoch(epoch, seed=100 + epoch)
    return next(rollouts).clone()


def test_a_batch_begins_where_the_last_one_ended(make):
    rollouts, episodes = make("env.make.max_episode_steps=100")
    first, second = (collect(rollouts, episodes, epoch) for epoch in range(2))
    assert not first["next", "done"].any()
    torch.testing.assert_close(second["observation"][:, 0], first["next", "observation"][:, -1])


def test_an_episode_reaches_its_time_limit_in_a_later_batch(make):
    rollouts, episodes = make("env.make.max_episode_steps=12")
    ends = torch.cat([collect(rollouts, episodes, epoch)["next", "done"] for epoch in range(3)], 1)
    assert ends[0].flatten().nonzero().flatten().tolist() == [11, 23]


def test_the_first_epoch_depends_on_its_seed_only(make):
    batches = []
    for before in (0, 7):
        rollouts, episodes = make()
        torch.manual_seed(before)
        for _ in range(before):
            next(rollouts)
        batches.append(collect(rollouts, episodes, 0))
    torch.testing.assert_close(batches[0]["observation"], batches[1]["observation"], rtol=0.0, atol=0.0)


@pytest.mark.parametrize(
    "overrides",
    [
        *(pytest.param(one, marks=pytest.mark.slow) for one in [(), ("frames=3",), ("action_history=3",)]),
        ("gap=joint_noise",),
    ],
    ids=str,
)
def test_a_resumed_run_goes_on_with_the_episodes_of_the_interrupted_one(make, overrides):
    rollouts, episodes = make(*overrides)
    for epoch in range(2):
        collect(rollouts, episodes, epoch)
    state = episodes.state_dict()
    expected = collect(rollouts, episodes, 2)

    rollouts, episodes = make(*overrides)
    collect(rollouts, episodes, 0)  # its episodes must be discarded
    episodes.load_state_dict(state)
    found = collect(rollouts, episodes, 2)
    for key in ("observation", "action", ("next", "observation"), ("next", "reward"), ("next", "done")):
        torch.testing.assert_close(found[key], expected[key], rtol=0.0, atol=0.0)


def test_an_env_that_cannot_save_its_episodes_begins_new_ones_and_marks_the_end_of_a_batch(make):
    rollouts, episodes = make("env.batched=false", worlds=None)
    assert not saves_episodes(make_env := episodes._env)
    assert not isinstance(make_env, BatchedMujocoEnv)
    assert episodes.state_dict() == {}
    batch = collect(rollouts, episodes, 0)
    assert batch["next", "truncated"].flatten().nonzero().flatten().tolist() == [15]
    assert not batch["next", "terminated"].any()
