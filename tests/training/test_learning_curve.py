"""The learning curve: the label of the return of the data."""

from types import SimpleNamespace

import matplotlib.pyplot as plt
import pytest

from torchrl_h2o.training.environments import task_of
from torchrl_h2o.training.learning_curve import draw_learning_curve
from torchrl_h2o.training.returns import Evaluation


@pytest.mark.parametrize(("length", "told"), [(80, " (episodes of 0 s)"), (40, ""), (39, "")])
def test_the_length_of_the_data_s_episodes_is_told_where_a_policy_s_end_sooner(
    compose, tmp_path, monkeypatch, length, told
):
    figures = []
    monkeypatch.setattr(plt, "close", figures.append)
    cfg, _ = compose()
    fell_at_once = {"updates": 20, "return_real": 3.0, "return_real_std": 1.0, "length_real": 2.0}
    draw_learning_curve(
        tmp_path / "drawn.png",
        {"H2O+": SimpleNamespace(rows=[fell_at_once])},
        Evaluation([9.0], [length]),
        task_of(cfg),
    )
    labels = [text.get_text() for text in figures[0].axes[0].get_legend().get_texts()]
    assert labels == ["H2O+", f"the data's behaviour{told}"]
