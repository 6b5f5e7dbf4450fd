"""Options of the algorithm: the recommended ones, those of the paper, and their order of precedence."""

import pytest

from tests.composed import composed

OPTIONS = ("n_steps", "layer_norm", "num_qvalue_nets", "mixing", "ratio_estimator")
PAPER = (1, False, 2, 0.1, "paper")


def chosen(config, *overrides):
    cfg = composed(config, *overrides)
    return tuple(cfg[option] for option in OPTIONS)


CASES = [
    pytest.param(config, env, marks=() if config == "train" or env == "halfcheetah" else pytest.mark.slow)
    for config in ("h2o_plus", "train", "paper")  # which read the same files of tasks
    for env in ("wheel_legged", "wheel_legged_forward", "halfcheetah", "walker2d")
]


@pytest.mark.parametrize(("config", "env"), CASES)
def test_the_paper_s_algorithm_has_a_name_for_every_task_and_recipe(config, env):
    overrides = [f"env={env}"]
    assert chosen(config, *overrides, "preset=paper") == PAPER
    assert chosen(config, *overrides) != PAPER


def test_ten_steps_of_the_robot_are_50_ms():
    assert chosen("h2o_plus")[0] == 10
    assert chosen("h2o_plus", "env=halfcheetah")[0] == 5


def test_an_option_on_the_command_line_comes_before_the_preset():
    assert chosen("train", "preset=paper", "n_steps=4")[0] == 4


@pytest.mark.parametrize(
    ("config", "env", "is_mended"),
    [
        ("h2o_plus", "wheel_legged", True),
        ("h2o_plus", "wheel_legged_forward", True),
        ("h2o_plus", "halfcheetah", False),
        ("train", "wheel_legged", False),
    ],
)
def test_the_first_command_alone_mends_the_robot_s_simulator(config, env, is_mended):
    cfg = composed(config, f"env={env}")
    assert (bool(cfg.mend), cfg.warm_start, cfg.keep == "best_in_simulator") == (is_mended,) * 3
    assert not composed(config, f"env={env}", "mend=false").mend
