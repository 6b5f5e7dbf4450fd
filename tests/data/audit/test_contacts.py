"""Models whose links touch in the measured rows."""

import mujoco
import numpy as np
import pytest

from tests.data.audit.recorded import NAMES, XML, measured, recording
from torchrl_h2o.data import audit
from torchrl_h2o.residuals import Simulation, StateMap

TRUNK = '<body name="trunk"><geom name="box" type="box" size="0.05 0.05 0.05"/><body name="upper">'
FLOOR = '<geom name="table" type="plane" size="1 1 1" pos="0 0 -0.2"/><body name="upper">'


def touching(world: str) -> Simulation:
    """The arm with contacts on, and something that its upper link touches."""
    xml = (
        XML.replace("<body pos", '<body name="lower" pos')
        .replace("<body>", world, 1)
        .replace(' contype="0" conaffinity="0"', "")
    )
    xml = xml.replace("</worldbody>", "</body></worldbody>") if "trunk" in world else xml
    state_map = StateMap.of_coordinates(NAMES, ("rad", "rad", "rad/s", "rad/s"), (0, 1, 2, 3), num_states=4)
    return Simulation(lambda: mujoco.MjSpec.from_string(xml), 2, state_map, (), "touching arm")


@pytest.mark.parametrize(("world", "bodies"), [(TRUNK, "trunk, upper"), (FLOOR, "lower, upper, world")])
def test_a_model_that_touches_itself_or_its_surroundings_is_no_fault_of_the_actions(world, bodies):
    found = audit(recording(rows=800), touching(world))
    assert found.severe == found.warnings == ()
    (note,) = [finding for finding in found.findings if "in contact" in finding.words]
    assert note.severity == "note"
    assert f"the model is in contact in 100% of the rows ({bodies})" in note.words


def test_rows_without_contact_are_still_compared():
    """A stop far out is touched in few rows."""
    stop = '<geom name="wall" type="box" size="0.01 1 1" pos="0.34 0 -0.2"/><body name="upper">'
    log = recording(rows=1000)
    found = audit(measured(np.vstack([log.observation, log.following[-1:]]), -log.action), touching(stop))
    assert any("in contact in" in finding.words for finding in found.findings)
    assert any("has the other sign" in finding.words for finding in found.severe)


def test_a_robot_that_drives_on_the_floor_gets_no_note():
    xml = """<mujoco><worldbody><geom type="plane" size="9 9 1"/><body pos="0 0 0.049"><joint name="x" type="slide"
    axis="1 0 0"/><geom type="box" size="0.05 0.05 0.05" condim="1"/></body></worldbody>
    <actuator><motor joint="x" gear="5"/></actuator></mujoco>"""
    state_map = StateMap.of_coordinates(("x", "x_velocity"), ("m", "m/s"), (0, 1), num_states=2)
    simulation = Simulation(lambda: mujoco.MjSpec.from_string(xml), 5, state_map, (), "box")
    action = 0.3 * np.random.default_rng(0).standard_normal((400, 1))
    rows = np.vstack([np.zeros(2), simulation.rollout(np.zeros((1, 2)), action[None])[0]])
    assert not [one for one in audit(measured(rows, action), simulation).findings if "in contact" in one.words]
