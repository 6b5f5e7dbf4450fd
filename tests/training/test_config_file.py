"""config.yaml of a run: what it says is kept, and options that it leaves out have their default values."""

import pytest
from omegaconf import open_dict

from torchrl_h2o.data import DataError
from torchrl_h2o.options import RunOptions, check_options
from torchrl_h2o.training.config_file import load_config, save_config


def test_options_that_a_folder_has_are_those_of_its_run(compose, tmp_path):
    cfg, _ = compose("action_history=2", "compiled=false", "keep=best_in_simulator")
    cfg.resume = "here"
    save_config(cfg, tmp_path)
    assert load_config(tmp_path) == cfg


def test_options_that_a_folder_leaves_out_have_their_default_values(compose, tmp_path):
    cfg, _ = compose(config="h2o_plus")
    with open_dict(cfg):
        del cfg["n_steps"], cfg["final_episodes"]
    save_config(cfg, tmp_path)
    loaded = load_config(tmp_path)
    assert (loaded.n_steps, loaded.final_episodes, loaded.method) == (5, 5, "h2o_plus")
    check_options(loaded, RunOptions, saved=True)


def test_a_wrong_option_in_a_folder_is_one_line_with_the_file(compose, tmp_path):
    cfg, _ = compose(config="h2o_plus")
    cfg.gamma = 1.5
    save_config(cfg, tmp_path)
    with pytest.raises(DataError, match=r"config.yaml: gamma=1.5: must be a number from 0 to 1; give the folder"):
        load_config(tmp_path)
