"""The changes of the off-dynamics files explain the recorded rows, and their rewards and falls are Gymnasium's."""

import gymnasium
import numpy as np
import off_dynamics
import pytest
from options import run_options

from torchrl_h2o.envs.task_rules import rules_of
from torchrl_h2o.residuals import Simulation
from torchrl_h2o.training.environments import task_of


@pytest.mark.parametrize(
    "file",
    [
        "halfcheetah_gravity_0.5_medium",
        "halfcheetah_kinematic_medium",
        "halfcheetah_morph_medium",
        "walker2d_gravity_0.5_medium",
        "walker2d_kinematic_medium",
        "walker2d_morph_medium",
    ],
)
def test_the_changed_task_predicts_the_file_and_the_unmodified_one_does_not(shared_data, file):
    path = shared_data / "off_dynamics" / f"{file}.hdf5"
    if not path.exists():
        pytest.skip(f"no {path}")
    cfg = run_options(f"env={off_dynamics.env_of_file(file)}", f"data={path}")
    task = task_of(cfg)
    real = task.read_real_data(cfg.data)[:1000]
    unmodified, changed = map(Simulation.from_env, (task.make_simulator(), task.make_reality()))
    before, after = (np.array(off_dynamics.errors(simulation, real)) for simulation in (unmodified, changed))
    assert after.max() < 2e-5  # m/s and rad/s: the data are in single precision
    assert before[1] > 0.01  # m/s, of z
    told = off_dynamics.differences(rules_of(gymnasium.make(cfg.env.make.env_name).unwrapped), changed, real)
    assert told["reward_error"] < 1e-4
    assert told["other_terminations"] == 0
