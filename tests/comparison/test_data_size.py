"""The figure of return against the amount of real data, and the tables with a number per seed."""

import pandas as pd
import pytest

from torchrl_h2o.comparison.data_size import FORWARD, POOR, REAL_LOG, STANDING, markdown, panels_of, points_of
from torchrl_h2o.comparison.data_size_figure import LOWEST
from torchrl_h2o.comparison.results_file import IDENTITY, RESULT
from torchrl_h2o.comparison.scores import MixedRunsError
from torchrl_h2o.comparison.seed_table import seed_tables
from torchrl_h2o.comparison.tables import report_data_size

ROBOT, FORWARD_ENV = "wheel_legged/standing_still", "wheel_legged/moving_forward"


def row(method, seed, value, size="", env=ROBOT, **others):
    who = dict.fromkeys((*IDENTITY, *RESULT), "") | {"env": env, "data": "recorded", "updates": "8000"}
    told = {"method": method, "seed": str(seed), "data_seconds": size, "return_mean": str(value), "seconds": "20.0"}
    return who | told | others


def placed(rows):
    return points_of(pd.DataFrame(rows))


def numbers(points, panel, method):
    """Values of a method's runs by seconds of real data."""
    runs = points[(points["panel"] == panel) & (points["method"] == method)]
    return {size: values.tolist() for size, values in runs.groupby("size")["value"]}


def some_rows():
    rows = [row("sac", seed, 9_000 * (seed + 1)) for seed in range(2)]
    for seed in range(2):
        rows += [row("iql", seed, value + 1000 * seed, size) for size, value in (("2.5", 18_000), ("", 170_000))]
        rows.append(row("sac", seed, 160_000, "2.5", mend="true"))
        rows.append(row("h2o_plus", seed, 100_000, "30", env="wheel_legged_poor/standing_still"))
        rows.append(row("iql", seed, 150_000, data="wheel_legged/standing_still.txt"))
        rows.append(row("iql", seed, 80_000, env=FORWARD_ENV, mean_v="0.15"))
    return rows


def test_runs_are_placed_by_task_data_mending_and_size():
    points = placed(some_rows())
    assert panels_of(points) == [STANDING, FORWARD, POOR, REAL_LOG]
    assert set(points.loc[points["panel"] == STANDING, "method"]) == {"sac", "iql", "sac_mended"}
    assert numbers(points, STANDING, "iql") == {2.5: [18_000, 19_000], 83.0: [170_000, 171_000]}
    assert list(numbers(points, STANDING, "sac_mended")) == [2.5]
    assert {size: len(runs) for size, runs in numbers(points, POOR, "h2o_plus").items()} == {30.0: 2}
    assert numbers(points, REAL_LOG, "iql")[83.0][0] == 150_000


def test_sac_that_uses_no_real_data_stands_at_every_size_and_beside_every_kind_of_data():
    points = placed(some_rows())
    standing = numbers(points, STANDING, "sac")
    assert list(standing) == [2.5, 10.0, 30.0, 83.0]
    assert numbers(points, POOR, "sac") == {30.0: standing[83.0]}
    assert numbers(points, REAL_LOG, "sac") == {83.0: standing[83.0]}
    assert not numbers(points, FORWARD, "sac")
    assert placed([row("sac", 0, 1)]).empty  # a grid that has not begun to use real data


def test_the_table_counts_runs_whose_simulator_mending_left_unchanged():
    rows = [row("sac", seed, 1, "2.5", mend="true", effects_added=added) for seed, added in enumerate(("0", "4", ""))]
    assert "nothing added in 1 (3)" in markdown(placed(rows))
    assert "nothing added" not in markdown(placed(some_rows()))


def test_runs_with_settings_that_the_figure_does_not_show_are_not_averaged():
    with pytest.raises(MixedRunsError, match=r"two runs of iql have seed 0 in the panel 'standing still' at 2\.5 s"):
        placed([row("iql", 0, 1, "2.5"), row("iql", 0, 2, "2.5", others="n_steps=10")])
    with pytest.raises(MixedRunsError, match=r"one amount of real data, but there are runs of \[10.0, 83.0\] s"):
        placed([row("iql", seed, 1, size, data="x/log.txt") for seed, size in enumerate(("10", ""))])
    assert placed([row("sac", 0, 1, "10", mend="posterior"), row("darc", 0, 1, "10")]).empty


def test_draws_from_the_posterior_are_a_line_of_their_own():
    mended, drawn = (row("h2o_plus", 0, 1000, "10", mend=mend) for mend in ("true", "posterior"))
    points = placed([mended, drawn])
    assert set(points["method"]) == {"h2o_plus_mended", "h2o_plus_posterior"}
    assert "| H2O+, posterior | 1,000; 20.0 s (1) |" in markdown(points)


def test_a_cell_has_return_seconds_speed_and_number_of_seeds():
    text = markdown(placed(some_rows()))
    assert "| IQL | 18,500 ± 707; 20.0 s (2) |  |  | 170,500 ± 707; 20.0 s (2) |" in text
    assert "| moving forward | 83 s |" in text
    assert "| IQL | 80,000 ± 0; 20.0 s; 0.15 m/s (2) |" in text
    assert "| SAC, mended simulator | 160,000 ± 0; 20.0 s (2) |" in text


def test_the_picture_shows_means_of_seeds_as_shares_of_a_faultless_episode(tmp_path, saved_figures):
    rows = [*some_rows(), *(row("cql", seed, -900_000, "2.5") for seed in range(2))]
    report_data_size(pd.DataFrame(rows), tmp_path, reps=20)
    assert "| IQL | 18,500 ± 707; 20.0 s (2) |" in (tmp_path / "data_size.md").read_text()
    axes = saved_figures[0].axes
    assert [axis.get_title() for axis in axes[:4]] == [STANDING, FORWARD, POOR, REAL_LOG]
    value, seconds = axes[0], axes[4]
    assert value.get_xscale() == "log"
    drawn = {line.get_label(): line.get_ydata().tolist() for line in value.lines}
    assert drawn.pop("CQL") == [LOWEST]
    assert drawn == {
        "IQL": pytest.approx([18_500 / 1_800, 170_500 / 1_800]),
        "SAC": pytest.approx([7.5] * 4),
        "SAC, mended simulator": pytest.approx([160_000 / 1_800]),
    }
    assert {value for line in seconds.lines for value in line.get_ydata()} == {20.0}
    assert {text.get_text() for text in saved_figures[0].legends[0].get_texts()} >= {"IQL", "CQL", "H2O+"}


def test_a_grid_without_runs_that_use_real_data_is_not_reported(tmp_path):
    with pytest.raises(MixedRunsError, match="no run of the figure"):
        report_data_size(pd.DataFrame([row("sac", 0, 1)]), tmp_path, reps=50)


def test_a_line_per_variant_and_a_column_per_seed():
    rows = [row("h2o_plus", seed, 1, others=o) for o in ("", "n_steps=10") for seed in (0, 2)]
    rows[3] |= {"seconds": "30.0"}
    rows += [row("h2o_plus", 2, 1, env=FORWARD_ENV, mean_v="0.2125", seconds="30")]
    for of_one in rows[:4]:
        of_one |= {"max_abs_x": "0.12", "mean_v": "0.001"}
    text = seed_tables(pd.DataFrame(rows))
    assert "| h2o_plus (defaults) | 20 | 20 | 0 of 2 |\n| h2o_plus n_steps=10 | 20 | 30 | 1 of 2 |" in text
    assert f"**{ROBOT}: largest distance from the start in reality, m**" in text
    assert "| h2o_plus n_steps=10 | 0.12 | 0.12 |" in text
    assert "mean speed" not in text.partition(ROBOT)[2]
    assert f"**{FORWARD_ENV}: mean speed in reality, m/s**\n\n| variant | seed 2 |" in text
    assert "| h2o_plus | 0.212 |" in text


def test_evaluations_during_training_are_lines_of_their_own():
    rows = [row("h2o_plus", 0, 1, at=str(at), seconds=str(at / 1000)) for at in (4000, 8000, 12000)]
    text = seed_tables(pd.DataFrame(rows), at=(4000, 8000))
    assert "| h2o_plus at=4000 | 4 | 0 of 1 |\n| h2o_plus at=8000 | 8 | 0 of 1 |" in text
    assert "12000" not in text
