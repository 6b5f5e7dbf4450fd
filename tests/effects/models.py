"""Small models for the tests, and functions that compare compiled models."""

from pathlib import Path

import gymnasium
import mujoco
import numpy as np

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
FILES = {
    "HalfCheetah": "half_cheetah.xml",
    "Walker2d": "walker2d.xml",
    "Hopper": "hopper.xml",
    "Ant": "ant.xml",
}
CART = """
<mujoco model="cart">
  <compiler inertiafromgeom="auto"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <body name="cart" pos="0 0 1">
      <joint name="slider" type="slide" axis="1 0 0"/>
      <inertial pos="0 0 0" mass="3" diaginertia="1 2 3"/>
      <geom name="box" type="box" size=".2 .1 .1"/>
      <body name="pole">
        <joint name="hinge" axis="0 1 0" pos="0 0 0"/>
        <geom name="rod" type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="0.5"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def task_xml(task: str) -> str:
    return (ASSETS / FILES[task]).read_text()


def spec(xml_or_task: str) -> mujoco.MjSpec:
    xml = task_xml(xml_or_task) if xml_or_task in FILES else xml_or_task
    return mujoco.MjSpec.from_string(xml)


def as_bytes(model: mujoco.MjModel) -> bytes:
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()
