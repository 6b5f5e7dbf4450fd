"""Part of the real data: the same first rows for every run, with an end; poor data, in which the robot falls."""

import pytest
import torch
from hydra.utils import instantiate
from torchrl.data import MultiStep

from tests.composed import composed
from torchrl_h2o.data import episodes
from torchrl_h2o.envs import record
from torchrl_h2o.training.environments import sim_capacity_of, task_of
from torchrl_h2o.training.real_data import behaviour_of, first_seconds, is_cut
from torchrl_h2o.training.run_folder import resolve_paths

STEP = 0.005  # s


def test_first_seconds_are_the_first_rows_and_end_in_truncation(compose):
    cfg, real = compose()
    part = task_of(cfg).read_real_data(cfg.data, cfg.columns, seconds=0.25)
    assert len(part) == 50
    for key in ("observation", "action", ("next", "observation"), ("next", "reward"), ("next", "terminated")):
        torch.testing.assert_close(part[key], real[key][:50])
    assert part["next", "done"].flatten().nonzero().flatten().tolist() == [39, 49]  # episodes of 40 steps
    assert part["next", "truncated"][-1]
    assert not real["next", "done"][49]  # the data that were read are not changed
    assert [len(episode) for episode in episodes(part)] == [40, 10]


def test_a_selection_that_ends_in_a_fall_is_not_truncated(compose):
    _, real = compose()
    real["next", "terminated"][19] = real["next", "done"][19] = True
    part = first_seconds(real, 0.1, STEP)
    assert part["next", "terminated"][-1]
    assert not part["next", "truncated"][-1]
    assert part["next", "done"][-1]


def test_targets_of_several_steps_do_not_use_rows_beyond_the_selection(compose):
    _, real = compose()
    part = first_seconds(real, 0.1, STEP)
    followed = torch.cat([part, real[60:80]])[None]
    reached = MultiStep(gamma=1.0, n_steps=5)(followed)
    last = part["next", "observation"][-1]
    for row in range(15, 20):
        torch.testing.assert_close(reached["next", "observation"][0, row], last)
        assert reached["steps_to_next_obs"][0, row] == 20 - row


@pytest.mark.parametrize("seconds", [1.005, 0.0, -1.0, 0.001])
def test_more_data_than_there_are_or_none_is_refused(compose, seconds):
    _, real = compose()
    with pytest.raises(ValueError, match=rf"data_seconds={seconds:g} selects .* the real data have 200, 1 s"):
        first_seconds(real, seconds, STEP)


def test_the_incomplete_last_episode_of_a_selection_is_not_the_behaviour(compose):
    cfg, real = compose("data_seconds=0.25")
    assert is_cut(cfg)
    part = first_seconds(real, cfg.data_seconds, STEP)
    assert behaviour_of(part, cut=True).lengths == [40]
    assert behaviour_of(part, cut=False).lengths == [40, 10]


def test_the_simulated_buffer_does_not_shrink_with_little_real_data(compose):
    cfg, real = compose()
    assert sim_capacity_of(cfg, len(real)) == cfg.sim_capacity_min == 100_000
    assert sim_capacity_of(cfg, 16_588) == 165_880


@pytest.mark.slow
def test_the_poor_controller_falls_within_five_seconds():
    poor, good = (composed("train", f"env={env}") for env in ("wheel_legged_poor", "wheel_legged"))
    assert poor.env.reality == good.env.reality
    assert poor.updates == good.updates == 16_000
    assert poor.env.name == "wheel_legged_poor"
    task = task_of(poor)
    real = record(task.make_reality(), instantiate(task.config["behaviour"]), 960, seed=0, progress=False)
    assert real["next", "terminated"].flatten().nonzero().flatten().tolist() == [pytest.approx(940, abs=15)]


def test_several_logs_are_read_as_runs_of_their_own_and_kept_by_absolute_names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, rows in (("a.txt", 5), ("b.txt", 8)):
        (tmp_path / name).write_text("0.1 0.2 0.0 0.4 1 0\n" * rows)
    for data in ("data=[a.txt,b.txt]", "data='*.txt'"):
        cfg = composed("h2o_plus", data)
        resolve_paths(cfg)
        real = task_of(cfg).read_real_data(cfg.data, cfg.columns)
        assert real["log"].bincount().tolist() == [4, 7]
        assert real["next", "done"].flatten().nonzero().flatten().tolist() == [3, 10]
        names = [cfg.data] if isinstance(cfg.data, str) else cfg.data
        assert all(str(name).startswith(str(tmp_path)) for name in names)
