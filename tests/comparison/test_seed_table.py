"""The tables with a number per seed."""

import pandas as pd

from torchrl_h2o.comparison.results_file import IDENTITY, RESULT
from torchrl_h2o.comparison.seed_table import seed_tables

ROBOT, FORWARD_ENV = "wheel_legged/standing_still", "wheel_legged/moving_forward"


def row(method, seed, value, env=ROBOT, **others):
    who = dict.fromkeys((*IDENTITY, *RESULT), "") | {"env": env, "data": "recorded", "updates": "8000"}
    return who | {"method": method, "seed": str(seed), "return_mean": str(value), "seconds": "20.0"} | others


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


def test_many_seeds_have_a_line_each():
    rows = [row("h2o_plus", seed, 1, others=o) for o in ("", "n_steps=10") for seed in range(13 if o else 14)]
    lines = seed_tables(pd.DataFrame(rows)).splitlines()
    assert "| seed | h2o_plus (defaults) | h2o_plus n_steps=10 |" in lines
    assert "| 12 | 20 | 20 |" in lines
    assert "| 13 | 20 |  |" in lines
    assert "| all 30 s | 0 of 14 | 0 of 13 |" in lines


def test_evaluations_during_training_are_lines_of_their_own():
    rows = [row("h2o_plus", 0, 1, at=str(at), seconds=str(at / 1000)) for at in (4000, 8000, 12000)]
    text = seed_tables(pd.DataFrame(rows), at=(4000, 8000))
    assert "| h2o_plus at=4000 | 4 | 0 of 1 |\n| h2o_plus at=8000 | 8 | 0 of 1 |" in text
    assert "12000" not in text
