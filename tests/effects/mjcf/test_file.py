"""Files of models: all digits, copied assets, and an earlier file that stays until the new one is complete."""

import mujoco
import numpy as np
import pytest

from tests.effects.models import task_xml
from tests.full_disk import full_disk
from torchrl_h2o.effects import BodyMass, Payload, compile_model
from torchrl_h2o.effects.mjcf import write_mjcf

WITH_MESHES = """
<mujoco>
  <compiler meshdir="meshes" texturedir="pictures"/>
  <asset>
    <mesh name="a" file="left/link.obj"/>
    <mesh name="b" file="right/link.obj" scale="2 2 2"/>
    <hfield name="ground" file="ground.bin" size="1 1 1 .1"/>
  </asset>
  <worldbody>
    <geom type="hfield" hfield="ground"/>
    <body pos="0 0 2"><freejoint/><geom type="mesh" mesh="a"/><geom type="mesh" mesh="b" pos="1 0 0"/></body>
  </worldbody>
</mujoco>
"""
TETRAHEDRON = "v 0 0 0\nv {size} 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.fixture
def robot(tmp_path):
    folder = tmp_path / "robot"
    for side, size in (("left", 1), ("right", 0.5)):
        (folder / "meshes" / side).mkdir(parents=True)
        (folder / "meshes" / side / "link.obj").write_text(TETRAHEDRON.format(size=size))
    with open(folder / "meshes" / "ground.bin", "wb") as file:
        np.array([2, 2], np.int32).tofile(file)
        np.array([0.0, 1.0, 0.5, 0.0], np.float32).tofile(file)
    (folder / "robot.xml").write_text(WITH_MESHES)
    return folder / "robot.xml"


def test_meshes_of_the_same_name_are_copied_and_the_folder_can_be_moved(robot, tmp_path):
    spec = mujoco.MjSpec.from_file(str(robot))
    model = compile_model(spec, [BodyMass(1.3)])
    write_mjcf(spec, tmp_path / "out" / "mended.xml")
    (tmp_path / "out").rename(tmp_path / "moved")
    robot.parent.rename(tmp_path / "gone")
    loaded = mujoco.MjModel.from_xml_path(str(tmp_path / "moved" / "mended.xml"))
    np.testing.assert_allclose(loaded.body_mass, model.body_mass, rtol=1e-12)
    np.testing.assert_array_equal(loaded.mesh_vert, model.mesh_vert)
    np.testing.assert_array_equal(loaded.hfield_data, model.hfield_data)
    assert len(list((tmp_path / "moved" / "mended_assets").iterdir())) == 3


def test_assets_that_are_not_files_are_written(robot, tmp_path):
    assets = {str(path.relative_to(robot.parent)): path.read_bytes() for path in robot.parent.rglob("*.*")}
    spec = mujoco.MjSpec.from_string(WITH_MESHES, assets=assets)
    path = write_mjcf(spec, tmp_path / "out" / "mended.xml")
    assert mujoco.MjModel.from_xml_path(str(path)).nmesh == 2


def test_all_digits_are_kept_and_short_numbers_stay_short(tmp_path):
    spec = mujoco.MjSpec.from_string(task_xml("HalfCheetah"))
    model = compile_model(spec, [Payload(1.0 / 3.0, x=0.1, bodies="torso")])
    path = write_mjcf(spec, tmp_path / "mended.xml")
    loaded = mujoco.MjModel.from_xml_path(str(path))
    np.testing.assert_allclose(loaded.body_inertia, model.body_inertia, rtol=1e-13)
    assert 'timestep="0.01"' in path.read_text()


def test_a_full_disk_leaves_the_earlier_file_and_nothing_else(tmp_path):
    path = tmp_path / "mended.xml"
    path.write_text("<mujoco/>")
    with full_disk(), pytest.raises(OSError, match="too large"):
        write_mjcf(mujoco.MjSpec.from_string(task_xml("HalfCheetah")), path)
    assert path.read_text() == "<mujoco/>"
    assert list(tmp_path.iterdir()) == [path]


def test_a_missing_mesh_is_an_error_before_anything_is_written(robot, tmp_path):
    (robot.parent / "meshes" / "left" / "link.obj").unlink()
    with pytest.raises((ValueError, OSError)):
        write_mjcf(mujoco.MjSpec.from_file(str(robot)), tmp_path / "out" / "mended.xml")
    assert not (tmp_path / "out" / "mended.xml").exists()
