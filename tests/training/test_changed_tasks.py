"""The changed tasks of a benchmark of others: their reality has the change, their simulator is the unmodified task."""

from functools import cache

import mujoco
import numpy as np
import pytest

from tests.composed import composed
from tests.effects.models import as_bytes, spec, task_xml
from torchrl_h2o.comparison.grids import OFF_DYNAMICS_FILES, env_of_file
from torchrl_h2o.comparison.scores import REFERENCES, normalised
from torchrl_h2o.effects import EarlierCapsules, compile_model
from torchrl_h2o.envs import mujoco_model
from torchrl_h2o.training.environments import task_of

TASKS = sorted({env_of_file(file) for file in OFF_DYNAMICS_FILES})
GYMNASIUM = {"halfcheetah": "HalfCheetah", "walker2d": "Walker2d"}


@cache
def task(name):
    return task_of(composed("train", f"env={name}"))


def reality(name):
    return mujoco_model(task(name).make_reality())


def unmodified(name, *effects):
    return compile_model(spec(GYMNASIUM[name.split("_")[0]]), effects)


EARLIER = EarlierCapsules(1.0)  # of the version of MuJoCo with which the data were recorded


def replaced(xml, changes):
    for old, new in changes.items():
        assert xml.count(old) == 1, old
        xml = xml.replace(old, new)
    return compile_model(mujoco.MjSpec.from_string(xml), [EARLIER])


@pytest.mark.parametrize("name", TASKS)
def test_the_simulator_is_the_unmodified_task(name):
    assert as_bytes(mujoco_model(task(name).make_simulator())) == as_bytes(unmodified(name))


@pytest.mark.parametrize("name", ["halfcheetah_gravity", "walker2d_gravity"])
def test_gravity_is_halved_and_nothing_else(name):
    found, expected = reality(name), unmodified(name, EARLIER)
    assert found.opt.gravity[2] == pytest.approx(-9.81 / 2)
    found.opt.gravity = expected.opt.gravity
    assert as_bytes(found) == as_bytes(expected)


@pytest.mark.parametrize(("name", "joint"), [("halfcheetah_kinematic", "bthigh"), ("walker2d_kinematic", "foot_joint")])
def test_one_joint_has_a_hundredth_of_its_range_and_nothing_else(name, joint):
    found, expected = reality(name), unmodified(name, EARLIER)
    own = expected.joint(joint).id
    np.testing.assert_allclose(found.jnt_range[own], 0.01 * expected.jnt_range[own])
    found.jnt_range[own] = expected.jnt_range[own]
    assert as_bytes(found) == as_bytes(expected)


SHAPE = ("body_pos", "body_mass", "body_ipos", "body_inertia", "jnt_pos", "jnt_range", "geom_pos", "geom_size")


def test_the_walker_has_a_thigh_of_5_mm_and_a_leg_of_745_mm():
    found, expected = reality("walker2d_morph"), unmodified("walker2d_morph")
    changes = {"thigh_geom": (-0.0025, 0.0025), "leg_geom": (0.25 - 0.745 / 2, 0.745 / 2)}
    for geom, (z, half) in changes.items():
        expected.geom(geom).pos[2], expected.geom(geom).size[1] = z, half
    expected.body("leg").pos[2], expected.body("foot").pos[2] = -0.005 - 0.25, 0.25 - 0.745 - 0.1
    for field in ("body_pos", "jnt_pos", "jnt_range", "geom_pos", "geom_size", "geom_friction"):
        np.testing.assert_allclose(getattr(found, field), getattr(expected, field), atol=1e-6, err_msg=field)
    density, radius = 1000.0, 0.05  # the mass follows from the capsule, which is weighed as a cylinder
    mass = density * np.pi * radius**2 * (0.005 + radius)
    assert found.body("thigh").mass[0] == pytest.approx(mass, rel=1e-4)


def test_the_cheetah_has_the_links_of_the_data_s_model():
    changes = {
        'axisangle="0 1 0 -3.8" name="bthigh" pos=".1 0 -.13" size="0.046 .145"': 'name="bthigh" size="0.046" '
        'fromto="0 0 0 -.0001 0 -.0001"',
        'name="bshin" pos=".16 0 -.25"': 'name="bshin" pos="-.0001 0 -.0001"',
        'axisangle="0 1 0 -2.03" name="bshin" pos="-.14 0 -.07"': 'name="bshin" fromto="0 0 0 -.13 0 -.15"',
        'name="bfoot" pos="-.28 0 -.14"': 'name="bfoot" pos="-.13 0 -.15"',
        'size="0.046 .094"': 'size="0.046 .07"',
        'axisangle="0 1 0 .52" name="fthigh" pos="-.07 0 -.12" size="0.046 .133"': 'name="fthigh" size="0.046" '
        'fromto="0 0 0 .0001 0 .0001"',
        'name="fshin" pos="-.14 0 -.24"': 'name="fshin" pos=".0001 0 .0001"',
        'axisangle="0 1 0 -.6" name="fshin" pos=".065 0 -.09"': 'name="fshin" fromto="0 0 0 .01 0 -.16"',
        'name="ffoot" pos=".13 0 -.18"': 'name="ffoot" pos=".01 0 -.16"',
    }
    found, expected = reality("halfcheetah_morph"), replaced(task_xml("HalfCheetah"), changes)
    for field in SHAPE:
        np.testing.assert_allclose(getattr(found, field), getattr(expected, field), atol=1e-4, err_msg=field)
    assert found.body_mass.sum() == pytest.approx(14.0)
    assert np.abs(_axes(found) - _axes(expected)).max() < 0.026  # rad; Gymnasium's shins are not quite straight


def _axes(model):
    """The axes of the shins, (2, 3); they have no sign."""
    axes = [np.zeros(9) for _ in range(2)]
    for axis, name in zip(axes, ("bshin", "fshin"), strict=True):
        mujoco.mju_quat2Mat(axis, model.geom(name).quat)
    return np.array([axis.reshape(3, 3)[:, 2] * np.sign(axis[8]) for axis in axes])


@pytest.mark.parametrize("name", TASKS)
def test_the_expert_of_the_data_scores_100(name):
    """High references of Lyu et al.; a mean return of their expert files, rounded, is within 10 of 100."""
    expert = {
        "halfcheetah_gravity": 8140,
        "halfcheetah_kinematic": 7006,
        "halfcheetah_morph": 9624,
        "walker2d_gravity": 5180,
        "walker2d_kinematic": 3080,
        "walker2d_morph": 4359,
    }
    low = -280.178953 if name.startswith("halfcheetah") else 10.079455
    assert normalised(low, REFERENCES[task(name).name]) == pytest.approx(0.0, abs=1e-3)
    assert 80.0 < normalised(expert[name], REFERENCES[task(name).name]) < 101.0
