"""The learning curve: the label of the return of the data, and the range of the returns."""

from types import SimpleNamespace

import pytest

from torchrl_h2o.training.learning_curve import draw_learning_curve
from torchrl_h2o.training.returns import Evaluation


@pytest.fixture
def drawn(tmp_path, saved_figures):
    """Draw the curve of a training with these returns, and return its left panel."""

    def draw(returns, behaviour):
        rows = [{"updates": 20 * i, "return_real": mean, "return_real_std": 1.0} for i, mean in enumerate(returns)]
        task = SimpleNamespace(name="robot", gap=None, max_episode_steps=40, seconds_per_step=0.001)
        draw_learning_curve(tmp_path / "drawn.png", {"H2O+": SimpleNamespace(rows=rows)}, behaviour, task)
        return saved_figures[-1].axes[0]

    return draw


@pytest.mark.parametrize(("length", "told"), [(80, " (episodes of 0 s)"), (40, ""), (39, "")])
def test_the_length_of_the_data_s_episodes_is_told_where_a_policy_s_end_sooner(drawn, length, told):
    labels = [text.get_text() for text in drawn([3.0], Evaluation([9.0], [length])).get_legend().get_texts()]
    assert labels == ["H2O+", f"the data's behaviour{told}"]


@pytest.mark.parametrize(
    ("returns", "data"),
    [([-1600.0, -800.0, -150.0], -300.0), ([-1600.0, -1000.0], 0.0), ([-40.0, 50.0], 100.0), ([-30.0, 0.0], -5.0)],
)
def test_all_returns_are_shown_if_the_highest_is_not_positive_or_the_lowest_is_not_far_below(drawn, returns, data):
    axis = drawn(returns, Evaluation([data], [40]))
    bottom, top = axis.get_ylim()
    assert bottom < min(*returns, data) <= max(*returns, data) < top
    assert not axis.texts


def test_returns_far_below_zero_are_cut_off_so_that_the_others_can_be_told_apart(drawn):
    axis = drawn([-900.0, 5.0, 90.0], Evaluation([100.0], [40]))
    assert axis.get_ylim() == (-25.0, pytest.approx(110.0))
    assert [text.get_text() for text in axis.texts] == ["lower returns are cut off"]
