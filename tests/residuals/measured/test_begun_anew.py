"""Transitions over which a run begins anew without a mark are left out of fits, of choices and of the report."""

from dataclasses import replace

import numpy as np
import torch
from tensordict import TensorDict

from tests.data.audit.recorded import arm, recording
from torchrl_h2o.data.audit.log import Log
from torchrl_h2o.residuals import Measured
from torchrl_h2o.residuals.measured.begun_anew import BEGUN_ANEW, begun_anew


def begun_elsewhere(row: int, angle: float = 1.5, noise: float = 0.01) -> Measured:
    """The arm's recording, whose shoulder is put elsewhere after a row, as if another episode followed."""
    data = recording(noise=noise)
    observation, following = data.observation.copy(), data.following.copy()
    observation[row + 1 :, 0] += angle
    following[row:, 0] += angle
    return replace(data, observation=observation, following=following)


def ted(data: Measured) -> TensorDict:
    rows = len(data)
    flags = {name: torch.zeros(rows, 1, dtype=torch.bool) for name in ("done", "terminated", "truncated")}
    following = {"observation": torch.tensor(data.following), "reward": torch.zeros(rows, 1), **flags}
    entries = {"observation": torch.tensor(data.observation), "action": torch.tensor(data.action), "next": following}
    return TensorDict(entries | {name: flag.clone() for name, flag in flags.items()}, batch_size=[rows])


def test_the_row_is_a_run_of_its_own_and_not_used():
    measured = Measured.from_ted(ted(begun_elsewhere(1000)), arm())
    assert measured.left_out == {BEGUN_ANEW: 1}
    assert np.flatnonzero(~measured.usable).tolist() == [1000]
    assert measured.runs == [slice(0, 1000), slice(1000, 1001), slice(1001, 2000)]


def test_motion_and_noise_are_no_beginnings():
    for noise in (0.0, 0.01, 0.1):
        assert not begun_anew(Log.of(recording(noise=noise), arm())).any()


def test_positions_that_do_not_belong_to_their_velocities_are_left_to_the_audit():
    data = recording(noise=0.0)
    degrees = np.array([180.0 / np.pi, 180.0 / np.pi, 1.0, 1.0])
    data = replace(data, observation=data.observation * degrees, following=data.following * degrees)
    assert not begun_anew(Log.of(data, arm())).any()
