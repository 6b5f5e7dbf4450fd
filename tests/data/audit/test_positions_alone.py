"""Audits of logs that hold positions alone, read from a coarse encoder."""

from dataclasses import replace

import numpy as np

from tests.data.audit.recorded import arm, measured, recording, rows_of
from torchrl_h2o.data import audit
from torchrl_h2o.residuals import StateMap

POSITIONS = replace(
    arm(),
    state_map=replace(
        StateMap.of_coordinates(("shoulder", "elbow"), ("rad", "rad"), (0, 1), num_states=4), hidden=(2, 3)
    ),
)


def positions(counts: float) -> tuple[np.ndarray, np.ndarray]:
    """The joints' angles, rounded as by encoders with ``counts`` steps per turn, and the actions."""
    log = recording(noise=0.0)
    step = 2.0 * np.pi / counts
    return step * np.round(rows_of(log)[:, :2] / step), log.action


def rows_findings(angles, action):
    found = audit(measured(angles, action), POSITIONS)
    return [finding.words for finding in (*found.severe, *found.warnings) if finding.check == "rows"]


def test_a_position_without_its_velocity_is_named_with_what_to_write():
    angles, action = positions(4096)
    found = audit(measured(angles, action), POSITIONS)
    (alone,) = [finding for finding in found.warnings if finding.check == "kinematics"]
    assert "no velocity is given for shoulder, elbow" in alone.words
    assert "derivative_of" in alone.remedy


def test_equal_readings_of_a_coarse_encoder_in_slow_motion_are_no_lost_packets():
    """Earlier, every row of such a log counted as one in motion, and 23 % of a real one as lost."""
    angles, action = positions(500)
    assert (np.diff(angles, axis=0) == 0.0).all(1).mean() > 0.02
    assert rows_findings(angles, action) == []


def test_lost_packets_of_positions_alone_are_found():
    angles, action = positions(4096)
    lost = np.random.default_rng(0).random(len(angles)) < 0.3
    lost[0] = False
    held = angles[np.maximum.accumulate(np.where(lost, 0, np.arange(len(angles))))]
    assert any("repeat the row before" in words for words in rows_findings(held, action))


def test_rows_at_rest_beside_a_sudden_move_are_no_lost_packets():
    """A servo that goes from point to point: earlier, up to a fifth of such rows counted as lost."""
    time = 0.01 * np.arange(2000)
    move = np.clip((time % 0.5) / 0.2, 0.0, 1.0) * 0.5 + 0.5 * (time // 0.5)
    step = 2.0 * np.pi / 4096
    angles = step * np.round(np.stack([0.3 * np.sin(move), 0.2 * np.cos(move)], 1) / step)
    assert rows_findings(angles, np.zeros((1999, 2))) == []
