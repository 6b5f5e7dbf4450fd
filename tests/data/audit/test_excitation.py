"""Which effects a log can tell apart."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from tests.data.audit.recorded import XML, recording
from torchrl_h2o.data.audit.excitation import sensitivities
from torchrl_h2o.data.audit.log import Log
from torchrl_h2o.data.audit.response import Response


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_gravity_does_not_show_on_an_arm_that_moves_in_the_plane(sign, simulation):
    """Also where the logged actions, here of the wrong sign, do not reduce the simulator's error."""
    flat = replace(simulation, spec=lambda: mujoco.MjSpec.from_string(XML.replace('axis="0 1 0"', 'axis="0 0 1"')))
    data = recording(rows=1000)
    log = Log.of(replace(data, action=sign * data.action), flat)
    response = Response.of(log, flat, 0.01 * log.observation.std(0))
    sizes = {str(one): np.abs(one.response).max() for one in sensitivities(response)}
    assert sizes["gravity"] == pytest.approx(0.0, abs=1e-6)
    assert sizes["motor gain of shoulder"] > 0.1
