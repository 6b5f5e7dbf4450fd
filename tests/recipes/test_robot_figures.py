"""The robot's figures: what they show is what the run's own table and data hold, in metres and radians."""

import json
import math

import matplotlib.pyplot as plt
import numpy as np
import pytest
from job import run_job
from methods import METHODS
from results_file import read_rows
from robot_figures import draw_robot, draw_trajectories, simulated_states, spread_entropy

from torchrl_h2o.envs.wheel_legged import MAX_PITCH


def test_what_is_shown_is_the_run_s_table_and_its_data_in_their_units(compose, tmp_path):
    cfg, _ = compose(
        "method=h2o_plus",
        "updates=20",
        "frames=2",
        "num_worlds=1",
        "env.make.max_episode_steps=300",
        config="train",
    )
    folder = tmp_path / "runs" / "one"
    folder.mkdir(parents=True)
    run_job(cfg, folder, [METHODS["h2o_plus"]])
    for _ in range(2):  # the second time nothing is new
        draw_robot(tmp_path / "runs", tmp_path, tmp_path)
    told = read_rows(tmp_path / "wheel_legged_trajectories.csv")
    summary = json.loads((folder / "summary.json").read_text())
    assert float(told[-1]["t"]) == pytest.approx(summary["return_real"]["mean_length"] * cfg.env.seconds_per_step)
    assert len({row["t"] for row in told}) == len(told)
    assert abs(float(told[0]["value"])) < 0.5  # m, after 0.2 s from the origin

    pitch, rate = simulated_states(cfg, folder).T
    assert len(pitch) == cfg.steps_per_epoch
    assert abs(pitch[0]) <= 0.05 + 1e-3  # rad, where episodes begin at most
    assert abs(rate[0]) <= 0.05 + 1e-3
    assert 0.05 < abs(pitch).max() < 1.5 * MAX_PITCH  # and where they end
    for name in ("wheel_legged_trajectories.png", "wheel_legged_diversity.png"):
        assert (tmp_path / name).stat().st_size > 10_000


def test_the_legend_names_the_methods_of_both_panels_once(tmp_path, monkeypatch):
    figures = []
    monkeypatch.setattr(plt, "close", figures.append)
    done = [("standing_still", "sac"), ("standing_still", "h2o"), ("moving_forward", "iql"), ("moving_forward", "sac")]
    rows = [
        {"task": task, "method": method, "seed": 0, "updates": 20, "t": t, "value": 0.1}
        for task, method in done
        for t in (0.0, 29.95)
    ]
    draw_trajectories(tmp_path / "drawn.png", rows)
    (legend,) = (axis.get_legend() for axis in figures[0].axes if axis.get_legend())
    expected = [METHODS[name].title for name in ("sac", "iql", "h2o")]
    assert [text.get_text() for text in legend.get_texts()] == [*expected, "target"]


def test_entropy_counts_the_cells_that_are_filled_evenly():
    cells = np.stack(np.meshgrid([-0.3, 0.0, 0.3], [-1.0, 1.0]), axis=-1).reshape(-1, 2)
    assert spread_entropy(np.repeat(cells, 7, axis=0)) == pytest.approx(math.log(6))
