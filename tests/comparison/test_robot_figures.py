"""The robot's figures: their values, in metres and radians, equal those in the run's table and data."""

import json
import math

import numpy as np
import pytest

from torchrl_h2o.comparison.results_file import append_run, read_rows
from torchrl_h2o.comparison.robot_figures import draw_robot, draw_trajectories
from torchrl_h2o.comparison.robot_trajectories import EVERY, counted, robot_results, simulated_states, spread_entropy
from torchrl_h2o.envs.wheel_legged.env import MAX_PITCH
from torchrl_h2o.training.job import run_job
from torchrl_h2o.training.methods import METHODS


@pytest.mark.slow
def test_what_is_shown_is_the_run_s_table_and_its_data_in_their_units(compose, tmp_path):
    short = ["updates=20", "frames=2", "num_worlds=1", "env.make.max_episode_steps=300", "final_episodes=5"]
    cfg, _ = compose("method=h2o_plus", *short, config="train")
    folder = tmp_path / "runs" / "one"
    folder.mkdir(parents=True)
    run_job(cfg, folder, [METHODS["h2o_plus"]])
    append_run(tmp_path / "wheel_legged.csv", cfg, folder)
    rows = read_rows(tmp_path / "wheel_legged.csv")
    found = robot_results(tmp_path / "runs", rows)
    (way,), (states,) = (found[kind]["standing_still", "h2o_plus"] for kind in ("way", "states"))
    assert way.shape == (5, 7)  # 1.5 s
    lasts = json.loads((folder / "summary.json").read_text())["return_real"]["mean_length"] * cfg.env.seconds_per_step
    seen = (~np.isnan(way)).sum() / 5 * EVERY
    assert seen <= lasts < seen + EVERY
    assert 0.0 < abs(way[:, 0]).max() < 0.5  # m; position 0.2 s after the start at the origin

    pitch, rate = simulated_states(cfg, folder).T
    waiting = cfg.n_steps  # newest steps; TorchRL's MultiStepTransform holds n steps back
    assert len(pitch) == states.sum() == cfg.steps_per_epoch - waiting
    assert abs(pitch[0]) <= 0.05 + 1e-3  # rad; bound of the initial pitch
    assert abs(rate[0]) <= 0.05 + 1e-3
    assert 0.05 < abs(pitch).max() < 1.5 * MAX_PITCH  # rad; episodes end at MAX_PITCH

    assert robot_results(tmp_path / "runs", rows.assign(mixing="0.9")) == {"way": {}, "states": {}}
    draw_robot(tmp_path, found)
    for name in ("wheel_legged_trajectories.png", "wheel_legged_diversity.png"):
        assert (tmp_path / name).stat().st_size > 10_000


def test_a_panel_a_method_and_a_cross_where_it_fell(tmp_path, saved_figures):
    stands, falls = np.full((1, 150), 0.1), np.r_[np.full(20, 0.3), np.full(130, np.nan)][None]
    ways = {("standing_still", "sac"): [falls, stands], ("moving_forward", "h2o_plus"): [stands]}
    draw_trajectories(tmp_path / "drawn.png", ways)
    axes = saved_figures[0].axes
    titles = [axis.get_title().partition(",") for axis in axes]
    assert [title for title, *_ in titles[:2]] == [METHODS["sac"].title, METHODS["h2o_plus"].title]
    assert [runs.split()[0] for *_, runs in titles] == ["2", "0", "0", "1"]
    crosses = [line for axis in axes for line in axis.lines if line.get_marker() == "x"]
    assert [(*line.get_xdata(), *line.get_ydata()) for line in crosses] == [(pytest.approx(4.0), 0.3)]


def test_entropy_counts_the_cells_that_are_filled_evenly():
    cells = np.stack(np.meshgrid([-0.3, 0.0, 0.3], [-1.0, 1.0]), axis=-1).reshape(-1, 2)
    assert spread_entropy(counted(np.repeat(cells, 7, axis=0))) == pytest.approx(math.log(6))
