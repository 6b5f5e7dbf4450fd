"""Parts of a model that effects act on."""

import mujoco
import pytest

from torchrl_h2o.effects.selection import driven_dofs

ARM = """
<mujoco>
  <worldbody>
    <body name="upper"><joint name="a" axis="0 1 0"/><geom size="0.1" pos="0 0 -0.3"/>
      <body name="lower" pos="0 0 -0.3"><joint name="b" axis="0 1 0"/><geom size="0.1" pos="0 0 -0.3"/>
        <site name="tip" pos="0 0 -0.3"/></body>
    </body>
  </worldbody>
  {rest}
</mujoco>
"""
LINKED = '<equality><joint joint1="a" joint2="b"/></equality>'


@pytest.mark.parametrize(
    ("rest", "driven"),
    [
        ("", set()),
        ('<actuator><motor joint="b"/></actuator>', {1}),
        ('<actuator><motor joint="b" gear="0"/></actuator>', set()),
        ('<actuator><motor site="tip" refsite="tip" gear="0 0 1 0 0 0"/></actuator>', set()),
        ('<actuator><motor site="tip" gear="0 0 1 0 0 0"/></actuator>', {0}),
        (f'{LINKED}<actuator><motor joint="b"/></actuator>', {0, 1}),
    ],
    ids=["none", "one", "no gear", "no motion", "a thruster along the arm", "linked joints"],
)
def test_degrees_of_freedom_on_which_an_actuator_acts(rest, driven):
    assert driven_dofs(mujoco.MjModel.from_xml_string(ARM.format(rest=rest))) == driven
