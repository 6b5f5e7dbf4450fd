"""Measured transitions: runs, windows within runs, and a reason where they allow no conclusion."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from tests.residuals.pendulum import pendulum
from torchrl_h2o.data import DataError
from torchrl_h2o.effects import Gravity
from torchrl_h2o.residuals import Measured, Split
from torchrl_h2o.residuals.measured.transitions import REMEMBERED

SIMULATION = pendulum()


def ted(rows=300, width=2, actions=1):
    """Each observation equals the following observation of the row before."""
    rng = torch.Generator().manual_seed(0)
    observed = torch.randn(rows + 1, width, generator=rng)
    flags = {name: torch.zeros(rows, 1, dtype=torch.bool) for name in ("done", "terminated", "truncated")}
    following = {
        "observation": observed[1:],
        "reward": torch.zeros(rows, 1),
        **{k: v.clone() for k, v in flags.items()},
    }
    return TensorDict(
        {
            "observation": observed[:-1].clone(),
            "action": torch.randn(rows, actions, generator=rng),
            "next": following,
            **flags,
        },
        batch_size=[rows],
    )


def of(data, **kwargs):
    return Measured.from_ted(data, SIMULATION, **kwargs)


def test_one_run_where_every_observation_follows():
    measured = of(ted())
    assert measured.runs == [slice(0, 300)]
    assert measured.observation.dtype == measured.action.dtype == np.float64


def test_runs_are_cut_where_observations_do_not_follow():
    data = ted()
    data["observation"][100:] += 1.0
    data["next", "observation"][100:] += 1.0
    assert of(data).runs == [slice(0, 100), slice(100, 300)]


def test_the_shown_time_goes_on_where_the_stamps_of_another_log_begin_anew():
    data = ted(6)
    data["time"] = torch.tensor([0.5, 0.6, 0.9, 0.2, 0.3, 0.4])[:, None].double()
    np.testing.assert_allclose(of(data).shown_time, [0.5, 0.6, 0.9, 1.0, 1.1, 1.2])
    data["time"] = torch.tensor([0.5, 0.6, 0.9, 1.0, 1.1, 1.2])[:, None].double()
    np.testing.assert_allclose(of(data).shown_time, data["time"].flatten().numpy())


def test_runs_are_cut_where_an_episode_ends_though_observations_follow():
    data = ted()
    data["next", "truncated"][99] = data["next", "done"][99] = True
    assert of(data).runs == [slice(0, 100), slice(100, 300)]


@settings(max_examples=60, deadline=None)
@given(
    breaks=st.lists(st.integers(1, 59), max_size=4),
    unusable=st.lists(st.integers(0, 59), max_size=4),
    border=st.integers(0, 60),
    horizon=st.integers(1, 12),
    stride=st.integers(1, 12),
)
def test_windows_cross_no_run_nor_unusable_row_nor_the_held_out_border(breaks, unusable, border, horizon, stride):
    rows = np.arange(60)
    measured = replace(
        of(ted(60)),
        run=np.isin(rows, breaks).cumsum(),
        usable=~np.isin(rows, unusable),
        split=np.where(rows >= border, Split.REPORT, Split.FIT),
    )
    for split in (Split.FIT, Split.REPORT, None):
        starts = measured.windows(horizon, stride, split=split)
        expected = []
        for start in range(0, 60 - horizon + 1, stride):
            window = slice(start, start + horizon)
            one_run = np.ptp(measured.run[window]) == 0
            right_part = split is None or (measured.split[window] == split).all()
            if one_run and right_part and measured.usable[window].all():
                expected.append(start)
        assert starts.tolist() == expected


def test_rows_for_fits_then_for_selection_then_for_the_report():
    split = of(ted(), held_out=0.3).split
    assert (np.diff(split) >= 0).all()
    assert np.bincount(split).tolist() == [153, 57, 90]


@pytest.mark.parametrize("share", [float("nan"), 1.0, -0.1])
def test_a_share_to_hold_out_that_is_none_is_refused(share):
    with pytest.raises(DataError, match=f"held_out={share} is no share of the transitions; give a share below 1"):
        of(ted(), held_out=share)


def test_borders_move_to_the_ends_of_runs_that_are_near():
    data = ted()
    for last in (159, 219):
        data["next", "truncated"][last] = data["next", "done"][last] = True
    assert np.bincount(of(data, held_out=0.3).split).tolist() == [160, 60, 80]


def test_named_logs_are_reported_on_and_chosen_by_no_fit():
    data = ted()
    data["log"] = torch.arange(300) // 75
    split = of(data, held_out=[1]).split
    assert (split[75:150] == Split.REPORT).all()
    assert not (np.delete(split, slice(75, 150)) == Split.REPORT).any()
    with pytest.raises(DataError, match="leave no log for fits"):
        of(data, held_out=[0, 1, 2, 3])


def four_logs(actions_of_the_first_two):
    """Logs of 75 rows, of which the last is reported on; each moves for its first 25 rows only."""
    data, row = ted(), torch.arange(300)
    data["log"] = row // 75
    moves = (row % 75 < 25)[:, None]
    data["observation"] *= moves
    data["next", "observation"][:-1] = data["observation"][1:]
    data["next", "done"][74::75] = True
    data["action"] *= torch.where(row < 150, actions_of_the_first_two, 1.0)[:, None] * moves
    return data


def test_each_of_several_logs_is_divided_where_they_differ_in_kind():
    """The first two logs have hardly any action, so no gain of a motor could be fitted to them."""
    split = of(four_logs(0.1)).split.reshape(4, 75)
    assert (split[3] == Split.REPORT).all()
    for part in split[:3]:
        (selected,) = np.nonzero(part == Split.SELECTION)
        assert 15 < selected[0] < selected[-1] < 32  # the motion is divided; the rest at the end is fitted
        assert (np.diff(selected) == 1).all()


def test_whole_logs_are_fitted_or_chosen_by_where_they_are_alike():
    split = of(four_logs(1.0)).split.reshape(4, 75)
    assert [set(part.tolist()) for part in split] == [{Split.FIT}, {Split.FIT}, {Split.SELECTION}, {Split.REPORT}]


def test_time_is_read_and_otherwise_counted_in_control_steps():
    data = ted()
    assert of(data).time[10] == pytest.approx(0.2)
    data["time"] = 5.0 + 0.02 * torch.arange(300, dtype=torch.float64)[:, None]
    assert of(data).time[10] == pytest.approx(5.2)


def test_rows_are_left_out_once_and_counted_by_reason():
    measured, rows = of(ted()), np.arange(300)
    less = measured.without(rows < 10, "a push").without(rows < 15, "a push").without(rows == 290, "a gap")
    assert less.left_out == {"a push": 15, "a gap": 1}
    assert np.flatnonzero(~less.usable).tolist() == [*range(15), 290]
    assert measured.usable.all()


def test_too_few_rows_are_no_conclusion_and_it_is_said_why():
    assert "199 usable transitions are too few" in of(ted(199)).why_no_conclusion()
    assert of(ted(200)).why_no_conclusion() is None
    assert "150 usable" in of(ted()).without(np.arange(300) < 150, "a push").why_no_conclusion()


def test_where_nothing_moves_is_no_conclusion_and_it_is_said_why():
    still = of(ted())
    still = replace(still, observation=np.ones_like(still.observation), following=np.ones_like(still.observation))
    assert "no observed value changes" in still.why_no_conclusion()


def test_one_dimension_that_stands_still_is_no_conclusion_and_it_is_said_which():
    data = ted()
    data["observation"][:, 0] = data["next", "observation"][:, 0] = 1.0
    assert "entries 0 never change" in of(data).why_no_conclusion()


@pytest.mark.parametrize(
    ("width", "actions", "column"), [(3, 1, "observation"), (1, 1, "observation"), (2, 2, "action")]
)
def test_a_width_that_the_simulator_does_not_have_is_refused(width, actions, column):
    with pytest.raises(
        DataError, match=rf"{column}.*the data have {max(width, actions) if column == 'action' else width}"
    ):
        of(ted(width=width, actions=actions), source="swing.csv")


def test_a_result_is_computed_once_for_equal_simulations_and_anew_for_others():
    measured, calls = of(ted()), []

    def count():
        calls.append(1)
        return len(calls)

    heavy = SIMULATION.with_effects(Gravity(2.0))
    assert measured.remembered("mass", heavy, count) == 1
    assert measured.remembered("mass", SIMULATION.with_effects(Gravity(2.0)), count) == 1
    assert measured.remembered("mass", SIMULATION, count) == 2
    assert measured.remembered("noise", heavy, count) == 3
    assert measured.part(slice(0, 100)).remembered("mass", heavy, count) == 4


def test_only_the_latest_results_are_kept():
    measured, calls = of(ted()), []
    for number in range(REMEMBERED + 1):
        measured.remembered(str(number), SIMULATION, lambda: calls.append(1))
    measured.remembered(str(REMEMBERED), SIMULATION, lambda: calls.append(1))
    assert len(calls) == REMEMBERED + 1
    measured.remembered("0", SIMULATION, lambda: calls.append(1))
    assert len(calls) == REMEMBERED + 2
