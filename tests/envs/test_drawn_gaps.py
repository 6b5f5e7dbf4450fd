"""Gaps that are drawn anew or assigned: at each reset, in workers, in collectors and in each world of a batch."""

from functools import partial

import numpy as np
import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs import DMControlEnv, GymEnv, HopperEnv, ParallelEnv, SerialEnv, TransformedEnv

from tests.effects.models import as_bytes
from tests.envs.rollouts import CHEETAH, gapped
from torchrl_h2o.effects import ActionGain, ActionNoise, Armature, GeomFriction, Gravity, JointForce, Timestep
from torchrl_h2o.envs import BatchedMujocoEnv, DynamicsGap, mujoco_model

TASK = "InvertedPendulum-v5"


def draw(rng):
    return [Gravity(rng.uniform(0.5, 2.0)), ActionGain(rng.uniform(0.5, 1.5))]


def make():
    return TransformedEnv(GymEnv(TASK), DynamicsGap(draw))


def gravities(env, resets):
    """Returns the scale of gravity in the model after each reset."""
    found = []
    for _ in range(resets):
        env.reset()
        found.append(mujoco_model(env).opt.gravity[2] / -9.81)
    return found


def test_a_gap_is_drawn_at_every_reset_and_the_seed_of_the_env_repeats_it():
    env = make()
    env.set_seed(3)
    first = gravities(env, 4)
    assert len(set(first)) == 4
    assert all(0.5 <= scale <= 2.0 for scale in first)
    assert env.transform.effects[0].scale == pytest.approx(first[-1])
    env.set_seed(3)
    assert gravities(env, 4) == first
    env.set_seed(4)
    assert gravities(env, 1) != first[:1]


def test_drawn_effects_on_actions_act_and_leave_the_model():
    env = TransformedEnv(GymEnv(TASK), DynamicsGap(lambda rng: [ActionGain(rng.choice([0.0, -1.0]))]))
    env.set_seed(0)
    model, moved = mujoco_model(env), {}
    for _ in range(8):
        td = env.reset()
        velocity = env.step(td.set("action", torch.full((1,), 3.0)))["next", "observation"][2]
        moved[env.transform.effects[0].scale] = velocity.item()
    assert abs(moved[0.0]) < 0.3
    assert moved[-1.0] < -0.5
    assert mujoco_model(env) is model


def test_a_drawn_gap_equals_a_fixed_one_of_the_same_values():
    env = gapped(lambda rng: [Gravity(rng.uniform(0.5, 2.0)), JointForce(1.0, "bthigh")])
    env.set_seed(0)
    found = env.rollout(4)
    fixed = gapped(*env.transform.effects)
    assert as_bytes(mujoco_model(fixed)) == as_bytes(mujoco_model(env))
    env.reset()
    other = gapped(*env.transform.effects)
    assert as_bytes(mujoco_model(other)) == as_bytes(mujoco_model(env))
    assert found.shape == (4,)


def test_a_gap_on_a_task_of_dm_control_is_drawn_too():
    env = TransformedEnv(DMControlEnv("pendulum", "swingup"), DynamicsGap(draw))
    env.set_seed(1)
    first = gravities(env, 3)
    assert len(set(first)) == 3
    env.set_seed(1)
    assert gravities(env, 3) == first


def test_two_drawn_gaps_on_one_env_are_drawn_apart():
    env = make().append_transform(DynamicsGap(lambda rng: [Gravity(rng.uniform(1.0, 2.0))]))
    for _ in range(3):
        env.reset()
        inner, outer = (gap.effects[0].scale for gap in env.transform)
        assert mujoco_model(env).opt.gravity[2] == pytest.approx(-9.81 * inner * outer)


def test_assigned_effects_act_from_the_next_reset_on():
    env = gapped(Gravity(2.0))
    found = []
    for scale in (0.5, 1.0, 1.5):
        env.transform.effects = [Gravity(scale)]
        before = mujoco_model(env).opt.gravity[2]
        env.reset()
        found.append((before / -9.81, mujoco_model(env).opt.gravity[2] / -9.81))
    np.testing.assert_allclose(found, [(2.0, 0.5), (0.5, 1.0), (1.0, 1.5)])
    env.transform.effects = [Armature(1.0, "nothing")]
    with pytest.raises(ValueError, match="no joint named 'nothing'"):
        env.reset()
    with pytest.raises(TypeError, match="got 'gravity'"):
        env.transform.effects = "gravity"
    made = make()
    made.transform.effects = [Gravity(2.0)]
    assert gravities(made, 2) == pytest.approx([2.0, 2.0])


def test_workers_draw_their_own_gaps_and_repeat_them():
    env = SerialEnv(2, make)

    def drawn():
        env.set_seed(5)
        return [(env.reset(), [mujoco_model(worker).opt.gravity[2] for worker in env._envs])[1] for _ in range(2)]

    first = drawn()
    assert len({scale for scales in first for scale in scales}) == 4
    assert drawn() == first


@pytest.mark.slow
def test_parallel_workers_draw_their_own_gaps_and_repeat_them():
    env = ParallelEnv(2, partial(TransformedEnv, GymEnv(TASK), DynamicsGap(draw)))

    def fallen():
        env.set_seed(5)
        td = env.reset().set("action", torch.ones(2, 1))
        return env.step(td)["next", "observation"] - td["observation"]

    first = fallen()
    assert not torch.equal(first[0], first[1])
    torch.testing.assert_close(fallen(), first)
    env.close()


def test_a_collector_sees_another_gap_in_every_episode():
    seen = []

    def spy(rng):
        seen.append(rng.uniform(0.5, 2.0))
        return [Gravity(seen[-1])]

    env = TransformedEnv(GymEnv(TASK), DynamicsGap(spy))
    collector = Collector(env, None, frames_per_batch=60, total_frames=60)
    (batch,) = [batch.clone() for batch in collector]
    collector.shutdown()
    episodes = int(batch["next", "done"].sum())
    assert episodes > 1
    assert len(set(seen[1:])) == len(seen) - 1 >= episodes


# ------------------------------------------------------------------------------------- batches of worlds
@pytest.mark.parametrize("inside", [True, False], ids=["of the env", "beside it"])
def test_each_world_is_drawn_at_its_own_reset(inside):
    def draw(rng):
        return [Gravity(rng.uniform(0.5, 2.0)), Timestep(rng.uniform(0.5, 1.0)), ActionNoise(rng.uniform(0.1, 1.0))]

    given = TransformedEnv(GymEnv(CHEETAH), DynamicsGap(draw)) if inside else GymEnv(CHEETAH)
    env = BatchedMujocoEnv(given, 3, () if inside else draw)

    def scales():
        return [model.opt.gravity[2] for model in env.models]

    env.set_seed(1)
    td = env.reset()
    first = scales()
    assert len(set(first)) == 3
    td = env.step(td.set("action", torch.zeros(3, 6)))["next"]
    td = env.reset(td.exclude("reward").set("_reset", torch.tensor([[False], [True], [False]])))
    second = scales()
    assert [a == b for a, b in zip(first, second, strict=True)] == [True, False, True]
    assert env._control_steps.tolist() == pytest.approx([5 * model.opt.timestep for model in env.models])
    env.set_seed(1)
    env.reset()
    assert scales() == first


def test_saved_episodes_keep_their_draws():
    def make():
        return BatchedMujocoEnv(GymEnv(CHEETAH), 2, lambda rng: [Gravity(rng.uniform(0.5, 2.0))])

    env, other = make(), make()
    td = env.step(env.reset().set("action", torch.ones(2, 6)))["next"]
    other.reset()
    other.restore_episodes(env.episodes_state())
    for one in (env, other):
        one.step(td.set("action", torch.zeros(2, 6)))
    np.testing.assert_array_equal(other.states, env.states)


# ------------------------------------------------------------------------------------------------ refusals
@pytest.mark.parametrize(
    "put",
    [
        lambda env: TransformedEnv(env, DynamicsGap(Gravity(2.0))),
        lambda env: TransformedEnv(env, DynamicsGap(lambda rng: [Gravity(2.0)])),
    ],
)
def test_an_effect_that_changes_nothing_is_refused(put):
    with pytest.raises(ValueError, match=r"Gravity \(gravity × 2\) changes nothing in model 'arm3d'"):
        put(GymEnv("Pusher-v5"))


def test_a_batch_refuses_an_effect_that_changes_nothing():
    with pytest.raises(ValueError, match=r"Gravity \(gravity × 1.5\) changes nothing in model"):
        BatchedMujocoEnv(GymEnv(CHEETAH), 2, [GeomFriction(2.0), Gravity(0.0), Gravity(1.5)])


def test_the_name_of_an_effect_is_refused_where_effects_are_expected():
    for give in (DynamicsGap, lambda name: BatchedMujocoEnv(GymEnv(CHEETAH), 2, name)):
        with pytest.raises(TypeError, match=r"expected effects such as Gravity\(2.0\), got 'gravity'"):
            give("gravity")


@pytest.mark.parametrize("action", [1.5, -1.5, float("nan")])
def test_actions_out_of_bounds_are_refused(action):
    env = BatchedMujocoEnv(GymEnv(CHEETAH), 2)
    td = env.reset().set("action", torch.zeros(2, 6))
    td["action"][1, 4] = action
    with pytest.raises(ValueError, match=rf"action of world 1 is {action:g} in entry 4, outside of \[-1, 1\]; clip it"):
        env.step(td)


def test_torchrl_s_own_mujoco_env_is_refused_with_the_reason():
    with pytest.raises(ValueError, match=r"HopperEnv is TorchRL's own MujocoEnv.*GymEnv\('Hopper-v5'\)"):
        TransformedEnv(HopperEnv(backend="mujoco", num_envs=1), DynamicsGap(Gravity(2.0)))
