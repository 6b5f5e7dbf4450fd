"""What the end of a run says about its policy."""

import pytest
from omegaconf import OmegaConf

from torchrl_h2o.training.judging import table_of_run, warnings_of, write_summary
from torchrl_h2o.training.returns import Evaluation

PLAIN = {
    "env": {"make": {"max_episode_steps": 100}},
    "mend": None,
    "warm_start": False,
    "keep": "last",
}
MENDED = PLAIN | {"mend": True, "warm_start": True, "keep": "best_in_simulator"}


def said(result, behaviour, options=PLAIN, rows=()):
    return warnings_of(OmegaConf.create(options), result, behaviour, rows)


@pytest.mark.parametrize(
    ("options", "remedy"),
    [
        (PLAIN, "set mend=true warm_start=true keep=best_in_simulator"),
        (PLAIN | {"mend": "report.json"}, "set warm_start=true keep=best_in_simulator"),
        (PLAIN | {"method": "iql"}, "set warm_start=true"),
        (MENDED, "train with another seed"),
    ],
)
def test_a_policy_that_is_worse_than_the_data_is_said_with_what_to_do(options, remedy):
    (warning,) = said(Evaluation([60.0], [60]), Evaluation([95.0, 97.0], [100, 100]), options)
    assert "worse in reality than the data's behaviour, whose return is 96" in warning
    assert remedy in warning


def test_a_policy_that_is_better_is_not_warned_of_nor_beside_longer_episodes_in_the_data():
    assert not said(Evaluation([99.0], [100]), Evaluation([95.0], [100]))
    assert not said(Evaluation([99.0], [100]), Evaluation([285.0], [300]))  # 95 in 100 steps
    assert said(Evaluation([90.0], [100]), Evaluation([285.0], [300]))
    assert not said(Evaluation([94.0, 97.0], [100] * 2), Evaluation([95.0, 97.0], [100] * 2))  # by chance


def test_without_a_limit_of_the_steps_whole_episodes_are_compared():
    no_limit = PLAIN | {"env": {"make": {}}}
    assert said(Evaluation([300.0], [60]), Evaluation([4000.0], [1000]), no_limit)


def test_weights_that_have_collapsed_are_said():
    good, data = Evaluation([99.0], [100]), Evaluation([95.0], [100])
    assert not said(good, data, rows=[{"ratio_of_sim": 0.01}, {"ratio_of_sim": 0.3}])
    (warning,) = said(good, data, rows=[{"ratio_of_sim": 0.3}, {"ratio_of_sim": 0.05}])
    assert "mean weight of simulated rows is 0.05" in warning
    assert "mend=true" in warning
    assert "ratio=false" in said(good, data, MENDED, [{"ratio_of_sim": 0.05}])[0]
    assert not said(good, data, rows=[{"loss_actor": 1.0}])  # a method without a ratio
    assert not said(good, data, PLAIN | {"ratio": False}, [{"ratio_of_sim": 0.05}])


def test_warnings_are_the_last_lines_of_a_run(tmp_path):
    result = Evaluation([60.0], [60])
    write_summary(tmp_path, {"warnings": ["the policy fell"]})
    assert table_of_run({"H2O+": result}, tmp_path, None, 0.1).splitlines()[-1] == "warning    the policy fell"
