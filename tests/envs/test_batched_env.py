"""BatchedMujocoEnv: each world equals Gymnasium's task from the same states under the same actions."""

import mujoco
import numpy as np
import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs import DoubleToFloat, GymEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_h2o.effects import (
    ActionDelay,
    ActionNoise,
    GearPlay,
    Gravity,
    LinearDrag,
    LoadFriction,
    ObservationDelay,
    ObservationGain,
    Timestep,
)
from torchrl_h2o.envs import BatchedMujocoEnv, DynamicsGap, WheelLeggedEnv, dynamics_gap, mujoco_model

TASKS = {
    "HalfCheetah": lambda: GymEnv("HalfCheetah-v5"),
    "Hopper": lambda: GymEnv("Hopper-v5"),
    "Walker2d": lambda: GymEnv("Walker2d-v5"),
    "HalfCheetah-v4": lambda: GymEnv("HalfCheetah-v4"),
    "Hopper-v4": lambda: GymEnv("Hopper-v4"),
    "Walker2d-v4": lambda: GymEnv("Walker2d-v4"),
    "standing still": lambda: WheelLeggedEnv("standing_still"),
    "moving forward": lambda: WheelLeggedEnv("moving_forward"),
}
WORLDS = 3


@pytest.mark.parametrize("name", TASKS)
def test_every_step_is_that_of_the_task_from_the_same_state(name):
    torch.manual_seed(0)
    env, single = BatchedMujocoEnv(TASKS[name](), WORLDS), TASKS[name]()
    task = single._env.unwrapped
    task.reset(seed=0)
    td, ended = env.reset(), 0
    falling = name.startswith(("Hopper", "Walker2d"))
    for _ in range(50 if falling else 6):
        td = env.rand_action(td)
        if name in ("standing still", "moving forward"):
            td["action"] *= 0.1
        before, td = env.states.copy(), env.step(td)
        for world in (0, WORLDS - 1):
            mujoco.mj_setState(task.model, task.data, before[world], mujoco.mjtState.mjSTATE_FULLPHYSICS)
            observation, reward, terminated, _, _ = task.step(td["action"][world].numpy())
            np.testing.assert_allclose(td["next", "observation"][world].numpy(), observation, atol=1e-9)
            assert td["next", "reward"][world].item() == pytest.approx(float(np.float32(reward)), abs=1e-9)
            assert td["next", "terminated"][world].item() == terminated
            ended += terminated
        td = env.maybe_reset(env.step_mdp(td))
    assert ended or not falling


@pytest.mark.parametrize("name", TASKS)
def test_an_episode_begins_as_gymnasium_begins_it(name):
    env = BatchedMujocoEnv(TASKS[name](), 1)
    env.set_seed(7)
    observation, _ = TASKS[name]()._env.unwrapped.reset(seed=7)
    np.testing.assert_array_equal(env.reset()["observation"][0].numpy(), observation)


def test_worlds_begin_differently_and_seeds_repeat_them():
    env = BatchedMujocoEnv(TASKS["HalfCheetah"](), WORLDS)
    env.set_seed(1)
    first = env.reset()["observation"]
    assert len(first.unique(dim=0)) == WORLDS
    assert not torch.equal(env.reset()["observation"], first)
    env.set_seed(1)
    assert torch.equal(env.reset()["observation"], first)


@pytest.mark.parametrize("name", TASKS)
def test_specs_are_kept(name):
    env = BatchedMujocoEnv(TASKS[name](), WORLDS)
    check_env_specs(env)
    single = TASKS[name]()
    assert env.observation_spec["observation"].dtype == single.observation_spec["observation"].dtype
    assert env.reward_spec.dtype == single.reward_spec.dtype


def test_an_episode_is_truncated_at_the_task_s_limit_and_worlds_are_reset_one_by_one():
    env = BatchedMujocoEnv(WheelLeggedEnv(max_episode_steps=5), WORLDS)
    td = env.reset()
    reset = td.clone().set("_reset", torch.tensor([[False], [True], [False]]))
    for _ in range(3):
        td = env.step(td.set("action", torch.zeros(WORLDS, 1)))["next"]
    before = td["observation"].clone()
    td = env.reset(td.exclude("reward").update(reset.select("_reset")))
    assert torch.equal(td["observation"][[0, 2]], before[[0, 2]])
    assert not torch.equal(td["observation"][1], before[1])
    for _ in range(2):
        td = env.step(td.set("action", torch.zeros(WORLDS, 1)))["next"]
    assert td["truncated"].squeeze(-1).tolist() == [True, False, True]
    assert td["done"].squeeze(-1).tolist() == [True, False, True]
    assert not td["terminated"].any()


@pytest.mark.parametrize(
    "effects",
    [
        (Gravity(1.5),),
        (ActionDelay(0.13),),
        (Timestep(0.5), ActionDelay(0.04)),
        (LinearDrag(3.0, bodies="torso"),),
        (LoadFriction(0.3), GearPlay(0.02, (1,))),
        (ObservationGain(1.2, (3,)),),
    ],
    ids=lambda effects: type(effects[0]).__name__,
)
@pytest.mark.parametrize("inside", [True, False], ids=["of the env", "beside it"])
def test_effects_do_what_a_dynamics_gap_does(effects, inside):
    single = TransformedEnv(TASKS["HalfCheetah"](), DynamicsGap(*effects))
    env = BatchedMujocoEnv(
        TransformedEnv(TASKS["HalfCheetah"](), DynamicsGap(*effects)) if inside else TASKS["HalfCheetah"](),
        2,
        () if inside else effects,
    )
    env.set_seed(3)
    task = single.base_env._env.unwrapped
    together, alone = env.reset(), single.reset()
    mujoco.mj_setState(task.model, task.data, env.states[0], mujoco.mjtState.mjSTATE_FULLPHYSICS)
    for _ in range(8):
        action = 2.0 * torch.rand(6) - 1.0
        together = env.step(together.set("action", action.expand(2, 6).clone()))["next"]
        alone = single.step(alone.set("action", action))["next"]
        torch.testing.assert_close(together["observation"][0], alone["observation"], rtol=0.0, atol=1e-9)


def test_every_world_can_have_effects_of_its_own():
    scales = np.linspace(0.5, 2.0, WORLDS)
    env = BatchedMujocoEnv(TASKS["HalfCheetah"](), WORLDS, [[Gravity(scale)] for scale in scales])
    assert [model.opt.gravity[2] for model in env.models] == pytest.approx(list(-9.81 * scales))
    env.reset()
    env.states[:] = env.states[0]
    td = env.step(env.reset().set("action", torch.zeros(WORLDS, 6)))
    falls = td["next", "observation"][:, 9]  # vertical velocity
    assert falls[0] > falls[1] > falls[2]
    with pytest.raises(ValueError, match="2 lists of effects for 3 worlds"):
        BatchedMujocoEnv(TASKS["HalfCheetah"](), WORLDS, [[Gravity(2.0)], []])


def test_numbers_that_depend_on_the_state_are_those_of_each_world():
    effects = [[LoadFriction(0.5)], [], [LoadFriction(0.1), GearPlay(0.02, (1,))]]
    env = BatchedMujocoEnv(TASKS["HalfCheetah"](), len(effects), effects)
    together, start = env.reset(), env.states.copy()
    torch.manual_seed(0)
    actions = 2.0 * torch.rand(6, 6) - 1.0
    for action in actions:
        together = env.step(together.set("action", action.expand(3, 6).clone()))["next"]
    for world, own in enumerate(effects):
        alone = BatchedMujocoEnv(TASKS["HalfCheetah"](), 1, own)
        single = alone.reset()
        alone.states[:] = start[world]
        for action in actions:
            single = alone.step(single.set("action", action[None].clone()))["next"]
        torch.testing.assert_close(together["observation"][world], single["observation"][0], rtol=0.0, atol=1e-9)
    assert not torch.equal(together["observation"][0], together["observation"][1])


def test_noise_of_the_action_differs_from_world_to_world_and_is_seeded_by_torch():
    env = BatchedMujocoEnv(TransformedEnv(TASKS["HalfCheetah"](), dynamics_gap("joint_noise")), WORLDS)

    def reached():
        torch.manual_seed(5)
        env.set_seed(0)
        return env.step(env.reset().set("action", torch.zeros(WORLDS, 6)))["next", "observation"]

    first = reached()
    assert torch.equal(reached(), first)
    quiet = BatchedMujocoEnv(TASKS["HalfCheetah"](), WORLDS)
    quiet.set_seed(0)
    still = quiet.step(quiet.reset().set("action", torch.zeros(WORLDS, 6)))["next", "observation"]
    assert len((first - still).unique(dim=0)) == WORLDS


STATEFUL = (ActionDelay(0.08), ActionNoise(0.2), ObservationDelay(0.07))


def go_on(env, td, steps):
    observed = []
    for _ in range(steps):
        td = env.step(td.set("action", torch.sin(td["observation"][:, :6] * 3.0)))["next"]
        observed.append(td["observation"].clone())
    return td, torch.stack(observed)


def test_saved_episodes_go_on_in_another_env_as_in_their_own():
    def make():
        return BatchedMujocoEnv(TransformedEnv(TASKS["HalfCheetah"](), DynamicsGap(*STATEFUL)), WORLDS)

    env, other = make(), make()
    td, _ = go_on(env, env.reset(), 5)
    state = env.episodes_state()
    go_on(other, other.reset(), 9)  # its episodes must be discarded
    _, expected = go_on(env, td.copy(), 6)
    other.restore_episodes(state)
    _, found = go_on(other, td.copy(), 6)
    torch.testing.assert_close(found, expected, rtol=0.0, atol=0.0)
    assert (other._steps == 11).all()


def test_noise_that_the_simulator_should_not_have_is_taken_away():
    noisy = TransformedEnv(TASKS["HalfCheetah"](), dynamics_gap("joint_noise"))
    env = BatchedMujocoEnv(noisy, 2, [ActionNoise(-1.0)])
    assert not env._alters_actions


def test_a_world_that_goes_on_is_not_read_again_while_another_is_reset():
    """A sensor delayed by two steps reports its old reading, also after a reset of another world."""
    env = BatchedMujocoEnv(WheelLeggedEnv(), 2, [ObservationDelay(0.01)])
    td, seen = env.reset(), []
    for step in range(4):
        td = env.step(td.set("action", torch.full((2, 1), 0.1)))["next"]
        seen.append(env.states[0, 3])  # the pitch of world 0
        if step == 2:
            td = env.reset(td.exclude("reward").set("_reset", torch.tensor([[False], [True]])))
    assert td["observation"][0, 0].item() == pytest.approx(seen[1], abs=1e-6)


def test_worlds_with_clocks_of_their_own_are_paid_by_them():
    env = BatchedMujocoEnv(TASKS["HalfCheetah"](), 2, [[], [Timestep(0.5)]])
    td = env.reset()
    before = env.states[:, 1].copy()
    reward = env.step(td.set("action", torch.zeros(2, 6)))["next", "reward"].squeeze(-1)
    velocity = (env.states[:, 1] - before) / np.array([0.05, 0.025])
    assert reward.tolist() == pytest.approx(velocity.tolist(), rel=1e-5)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: GymEnv("HalfCheetah-v5", frame_skip=2), "repeats actions"),
        (
            lambda: TransformedEnv(GymEnv("HalfCheetah-v5"), DoubleToFloat()),
            r"would ignore \(DoubleToFloat\): put them around",
        ),
    ],
)
def test_what_a_batch_would_leave_out_is_refused(make, said):
    with pytest.raises(ValueError, match=said):
        BatchedMujocoEnv(make(), 2)


def test_it_feeds_a_collector():
    env = BatchedMujocoEnv(TASKS["Walker2d"](), 4)
    collector = Collector(env, frames_per_batch=400, total_frames=400)
    (batch,) = list(collector)
    assert batch.shape == (4, 100)
    assert batch["next", "terminated"].any()
    following, begun = batch["next", "observation"][:, :-1], batch["observation"][:, 1:]
    done = batch["next", "done"][:, :-1, 0]
    assert torch.equal(following[~done], begun[~done])
    assert not torch.equal(following[done], begun[done])


def test_a_task_whose_rules_are_not_known_says_what_to_do():
    with pytest.raises(ValueError, match=r"AntEnv cannot be stepped in a batch.*TaskRules"):
        BatchedMujocoEnv(GymEnv("Ant-v5"), 2)


def test_the_model_of_the_env_that_was_given_stays_as_it_was():
    given = TASKS["HalfCheetah"]()
    BatchedMujocoEnv(given, 2, [Gravity(2.0)]).rollout(3)
    assert mujoco_model(given).opt.gravity[2] == pytest.approx(-9.81)
