"""DynamicsGap on dm_control tasks."""

import copy
import pickle

import mujoco
import numpy as np
import pytest
import torch
from torchrl.envs import DMControlEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.effects.models import as_bytes
from tests.envs.own_effects import ControlForce
from torchrl_h2o.effects import (
    PAPER_GAPS,
    ActionDelay,
    BodyMass,
    JointForce,
    LinearDrag,
    ObservationBias,
    paper_gap,
)
from torchrl_h2o.envs import DynamicsGap, dynamics_gap, mujoco_model

TASKS = [("cheetah", "run"), ("walker", "walk")]
MISSING = [("walker", "long_torso"), ("walker", "soft_feet")]
# those of walker differ from cheetah's in the names of the geoms, which one gap shows
FAST = {"gravity", "joint_noise", "big_thigh", "soft_feet"}  # of options, actions, geometry and joints
CASES = [
    *(
        pytest.param(("cheetah", "run"), name, marks=() if name in FAST else pytest.mark.slow, id=f"cheetah-{name}")
        for name in PAPER_GAPS
    ),
    pytest.param(("walker", "walk"), "big_thigh", id="walker-big_thigh"),
]


def rollout(env, steps=4, seed=0):
    torch.manual_seed(seed)
    env.set_seed(seed)
    return env.rollout(steps)


@pytest.mark.parametrize(("task", "name"), CASES)
def test_a_gap_of_the_paper_holds_the_specs_and_changes_the_model(task, name):
    plain = DMControlEnv(*task)
    before = as_bytes(mujoco_model(plain))
    env = TransformedEnv(plain, dynamics_gap(name))
    assert (as_bytes(mujoco_model(env)) == before) == (name == "joint_noise")
    if name in ("gravity", "joint_noise"):
        check_env_specs(env)


@pytest.mark.parametrize(("domain", "name"), sorted(MISSING))  # every worker of pytest needs the same order
def test_a_gap_that_walker_does_not_have_is_refused(domain, name):
    with pytest.raises(ValueError, match="cannot be put into model 'planar walker'"):
        TransformedEnv(DMControlEnv(domain, "walk"), dynamics_gap(name))


@pytest.mark.parametrize("task", TASKS[:1])
def test_neutral_effects_leave_every_bit_of_a_rollout(task):
    expected = rollout(DMControlEnv(*task))
    gap = DynamicsGap(BodyMass(), LinearDrag(), ActionDelay())
    actual = rollout(TransformedEnv(DMControlEnv(*task), gap))
    assert (actual == expected).all()


@pytest.mark.parametrize("task", TASKS[1:])
def test_a_force_of_nothing_leaves_every_bit_of_a_rollout(task):
    # 1e-320 is not neutral, so physics steps are taken one by one, but the force is below rounding
    env = TransformedEnv(DMControlEnv(*task), DynamicsGap(LinearDrag(1e-320)))
    assert (rollout(env) == rollout(DMControlEnv(*task))).all()


def test_task_and_named_views_see_the_changed_simulation():
    env = TransformedEnv(DMControlEnv("cheetah", "run"), dynamics_gap("big_thigh"))
    data = rollout(env)
    physics = env.base_env._env.physics
    assert physics.named.model.geom_size["bthigh", 0] == pytest.approx(2 * 0.046)
    assert physics.model.ptr is mujoco_model(env)
    # the reward depends on the speed, which the task reads through a named view of the new data
    assert physics.named.data.sensordata["torso_subtreelinvel"][0] == physics.speed()
    assert data["next", "reward"][-1].item() == pytest.approx(max(0.0, physics.speed() / 10))
    assert mujoco_model(env).body_mass.sum() == pytest.approx(14.0)


def test_forces_act_anew_at_every_physics_step():
    effect = LinearDrag(50.0, "torso")
    env = TransformedEnv(DMControlEnv("walker", "walk"), DynamicsGap(effect))
    env.set_seed(0)
    reset = env.reset()
    physics, model = env.base_env._env.physics, mujoco_model(env)
    physics.data.qvel[0] = 5.0
    data, current = mujoco.MjData(model), mujoco.MjData(model)
    for field in ("qpos", "qvel", "qacc_warmstart"):
        getattr(data, field)[:] = getattr(physics.data, field)
    physics.forward()
    drag = effect.process(model, np.random.default_rng(0))
    for _ in range(10):
        current.qpos[:], current.qvel[:] = data.qpos, data.qvel
        mujoco.mj_forward(model, current)
        data.qfrc_applied[:] = drag(current)
        mujoco.mj_step(model, data)
    env.step(reset.set("action", torch.zeros(6, dtype=torch.float64)))
    np.testing.assert_allclose(physics.data.qvel, data.qvel, rtol=1e-6)


def test_a_force_sees_the_control_of_its_own_step():
    env = TransformedEnv(DMControlEnv("cheetah", "run"), DynamicsGap(ControlForce(1e3)))
    env.set_seed(0)
    action = torch.zeros(6, dtype=torch.float64)
    action[0] = 1.0
    env.step(env.reset().set("action", action))
    # cheetah's control step is one physics step, so it would not reveal a force delayed by one step
    plain = DMControlEnv("cheetah", "run")
    plain.set_seed(0)
    plain.step(plain.reset().set("action", action))
    speeds = [e._env.physics.data.qvel[0] for e in (env.base_env, plain)]
    assert speeds[0] - speeds[1] > 0.1


def test_the_observation_entries_are_counted_over_all_keys():
    # position has 8 entries, so entry 9 is the second velocity
    env = TransformedEnv(DMControlEnv("cheetah", "run"), DynamicsGap(ObservationBias(0.5, entries=(9,))))
    expected, actual = rollout(DMControlEnv("cheetah", "run")), rollout(env)
    offset = torch.zeros(9, dtype=torch.float64)
    offset[1] = 0.5
    torch.testing.assert_close(actual["velocity"], expected["velocity"] + offset)
    torch.testing.assert_close(actual["position"], expected["position"])


def test_two_envs_do_not_touch_each_other():
    untouched = DMControlEnv("cheetah", "run")
    model = as_bytes(mujoco_model(untouched))
    gap = DynamicsGap(paper_gap("gravity"), JointForce(5.0, "rootx"))
    rollout(TransformedEnv(DMControlEnv("cheetah", "run"), gap))
    assert as_bytes(mujoco_model(untouched)) == model
    assert (rollout(untouched) == rollout(DMControlEnv("cheetah", "run"))).all()


@pytest.mark.parametrize(
    "duplicate",
    [pytest.param(copy.deepcopy, marks=pytest.mark.slow), lambda e: pickle.loads(pickle.dumps(e))],
    ids=["deepcopy", "pickle"],
)
def test_a_copied_env_keeps_its_gaps(duplicate):
    env = TransformedEnv(DMControlEnv("walker", "walk"), DynamicsGap(paper_gap("gravity"), JointForce(5.0)))
    env.append_transform(dynamics_gap("friction"))
    rollout(env)
    twin = duplicate(env)
    assert (rollout(twin) == rollout(env)).all()
    assert as_bytes(mujoco_model(twin)) == as_bytes(mujoco_model(env))


def test_a_model_changed_by_hand_is_not_silently_replaced():
    env = DMControlEnv("cheetah", "run")
    mujoco_model(env).opt.gravity[2] = -1.0
    with pytest.raises(ValueError, match=r"changed after loading.*Make the change an effect"):
        TransformedEnv(env, DynamicsGap(BodyMass(2.0)))


@pytest.mark.parametrize(
    "task",
    [
        ("reacher", "easy"),
        *(pytest.param(task, marks=pytest.mark.slow) for task in [("finger", "turn_hard"), ("point_mass", "hard")]),
    ],
    ids="-".join,
)
def test_what_a_task_writes_at_its_reset_is_no_change_by_hand(task):
    env = DMControlEnv(*task)
    env.reset()
    TransformedEnv(env, dynamics_gap("gravity")).rollout(2)


@pytest.mark.parametrize(
    ("task", "complaint"),
    [
        (("swimmer", "swimmer6"), r"swimmer6.* builds the model from arguments \(n_joints\)"),
        (("lqr", "lqr_2_1"), r"lqr_2_1.* from arguments \(n_bodies, n_actuators, random\)"),
        (("quadruped", "walk"), r"quadruped, task=walk.* has no function get_model_and_assets"),
        pytest.param(("dog", "walk"), r"dog, task=walk.* built with other arguments", marks=pytest.mark.slow),
    ],
)
def test_a_task_whose_model_cannot_be_built_anew_is_named(task, complaint):
    with pytest.raises(ValueError, match=complaint):
        TransformedEnv(DMControlEnv(*task), dynamics_gap("gravity"))


def test_a_model_built_in_code_is_not_mistaken_for_the_one_in_the_file():
    with pytest.raises(ValueError, match="the model must come from its file"):
        TransformedEnv(DMControlEnv("cartpole", "two_poles"), dynamics_gap("gravity"))
