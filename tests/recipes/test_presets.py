"""Options of the algorithm: the recommended ones, those of the paper, and their order of precedence."""

import hydra
import pytest

from tests.small_runs import ROOT

OPTIONS = ("n_steps", "layer_norm", "num_qvalue_nets", "mixing", "ratio_estimator")
PAPER = (1, False, 2, 0.1, "paper")


def chosen(config, *overrides):
    with hydra.initialize_config_dir(str(ROOT / "recipes" / "config"), version_base=None):
        cfg = hydra.compose(config, list(overrides))
    return tuple(cfg[option] for option in OPTIONS)


@pytest.mark.parametrize("env", ["wheel_legged", "wheel_legged_forward", "halfcheetah", "walker2d"])
@pytest.mark.parametrize("config", ["h2o_plus", "train", "paper"])
def test_the_paper_s_algorithm_has_a_name_for_every_task_and_recipe(config, env):
    overrides = [f"env={env}"]
    assert chosen(config, *overrides, "preset=paper") == PAPER
    assert chosen(config, *overrides) != PAPER


def test_ten_steps_of_the_robot_are_50_ms():
    assert chosen("h2o_plus")[0] == 10
    assert chosen("h2o_plus", "env=halfcheetah")[0] == 5


def test_an_option_on_the_command_line_comes_before_the_preset():
    assert chosen("train", "preset=paper", "n_steps=4")[0] == 4
