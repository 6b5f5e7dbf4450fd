"""The paper's grids, and those of our own: which runs they have."""

from collections import Counter
from functools import partial

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf, open_dict

from tests.composed import composed
from torchrl_h2o.comparison.grids import FIGURES, TABLES, check_overrides, chosen_grid
from torchrl_h2o.comparison.options import PaperOptions
from torchrl_h2o.comparison.results_file import identity
from torchrl_h2o.options import check_options

#: options that identity() reads
IDENTIFYING = ["method", "env", "data", "data_seconds", "mend", "mended", "gap", "gap_strength", "seed", "updates"]
IDENTIFYING += ["backbone", "mixing", "ratio", "overrides"]


paper = partial(composed, "paper")


def chosen(runs, key):
    values = [override.partition("=")[2] for run in runs for override in run if override.startswith(f"{key}=")]
    return Counter(values)


def test_the_main_table_has_every_cell_once_and_methods_without_simulator_once_a_data_set():
    runs = list(TABLES["returns"].runs((0, 1)))
    assert len(runs) == 2 * (25 * 4 + 3 * 2)
    assert chosen(runs, "method") == {"sac": 50, "darc": 50, "h2o": 50, "h2o_plus": 50, "cql": 6, "iql": 6}
    assert len({tuple(run) for run in runs}) == len(runs)
    walker = [run for run in runs if "env=walker2d" in run]
    assert {"gap=long_torso", "gap=soft_feet"}.isdisjoint(override for run in walker for override in run)


def test_the_ablations_are_the_paper_s():
    mixing = list(TABLES["mixing"].runs((0,)))
    assert chosen(mixing, "mixing") == {"0.0": 1, "0.1": 2, "0.2": 1, "0.5": 1, "1.0": 1}
    assert chosen(mixing, "ratio") == {"false": 1}
    assert chosen(TABLES["gaps"].runs((0,)), "gap_strength") == {"1.25": 2, "1.5": 2, "2.0": 2, "3.0": 2}
    assert len(list(FIGURES["backbones"].runs((0,)))) == 8
    assert len(list(FIGURES["wheel_legged"].runs((0,)))) == 12


def test_any_subset_is_an_override():
    cfg = paper("table=returns", "methods=[h2o_plus,iql]", "gaps=[gravity,friction]", "seeds=[0,1]")
    runs = list(chosen_grid(cfg).runs(tuple(cfg.seeds)))
    assert chosen(runs, "method") == {"h2o_plus": 2 * 3 * 2, "iql": 2 * 3}
    assert chosen(runs, "gap") == {"gravity": 6, "friction": 6, "null": 6}


def test_data_sets_are_any_that_have_the_environment_in_their_name_and_tasks_any_environment():
    public, hdf5 = "mujoco/walker2d/expert-v0", "files/halfcheetah_medium-v2.hdf5"
    cfg = paper("table=returns", f"datasets=[{public},{hdf5}]", "gaps=[gravity]", "methods=[sac]")
    runs = list(chosen_grid(cfg).runs((0,)))
    assert [run[1:3] for run in runs] == [["env=walker2d", f"data={public}"], ["env=halfcheetah", f"data={hdf5}"]]
    own = list(chosen_grid(paper("table=methods", "tasks=[mine]")).runs((0,)))
    assert chosen(own, "env") == {"mine": 6}
    assert not chosen(own, "gap")


@pytest.mark.parametrize("overrides", [["table=main"], [], ["table=returns", "figure=backbones"]])
def test_a_grid_that_there_is_not_is_said(overrides):
    with pytest.raises(ValueError, match=r"must be returns, mixing, gaps|name one"):
        check_options(paper(*overrides), PaperOptions)


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["table=returns", "methods=[ppo]"], r"methods=\[ppo\]: choose sac, cql"),
        (["table=returns", "datasets=[hopper/medium-v0]"], "its name must contain halfcheetah or walker2d"),
        (["table=methods"], r"name tasks=\[...\]"),
        (["figure=wheel_legged", "gaps=[gravity]"], "has no data sets, so gaps would have no effect"),
    ],
)
def test_a_choice_that_there_is_not_is_said_before_anything_runs(overrides, said):
    with pytest.raises(ValueError, match=said):
        chosen_grid(paper(*overrides))


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["table=returns", "gaps=[gravty]"], r"gaps=\[gravty\]: must be .*did you mean gravity\?"),
        (["table=returns", "methods=iql"], r"methods=iql: must be null or a list of names"),
        (["table=returns", "seeds=[]"], r"seeds=\[\]: must be a list of one or more integers"),
    ],
)
def test_a_selection_of_another_type_is_refused(overrides, said):
    with pytest.raises(ValueError, match=said):
        check_options(paper(*overrides), PaperOptions)


@pytest.mark.parametrize(
    ("grid", "override", "said"),
    [
        (TABLES["returns"], "gap=friction", r"set gap themselves; choose with gaps="),
        (TABLES["returns"], "+seed=1", r"choose with seeds="),
        (TABLES["returns"], "gap_strength=3", r"choose with strengths="),
        (FIGURES["backbones"], "backbone=sparse", "leave it out, or take another grid"),
    ],
)
def test_what_each_run_says_for_itself_is_no_override_of_all(grid, override, said):
    runs = list(grid.runs((0,)))
    with pytest.raises(ValueError, match=said):
        check_overrides(["updates=10", override], runs)
    check_overrides(["updates=10", "env.make.max_episode_steps=40", "mixing=0.3"], list(TABLES["returns"].runs((0,))))


@pytest.mark.parametrize("grid", [TABLES["mixing"], TABLES["gaps"]])
def test_runs_that_differ_have_different_identities(grid):
    found = {}
    for run in grid.runs((0,)):
        env = next(override for override in run if override.startswith("env="))
        cfg = OmegaConf.masked_copy(paper(env), IDENTIFYING)
        with open_dict(cfg):
            cfg.overrides = run
            for override in OverridesParser.create().parse_overrides(run):
                if override.key_or_group != "env":
                    cfg[override.key_or_group] = override.value()
        found[tuple(run)] = identity(cfg)
    assert len({tuple(who.values()) for who in found.values()}) == len(found)
    assert {who["others"] for who in found.values()} == {""}
    for run, who in found.items():
        assert [f"mend={who['mend']}"] * bool(who["mend"]) == [one for one in run if one.startswith("mend=")]
        assert who["data_seconds"] in ("", *(one.partition("=")[2] for one in run))


def test_every_run_is_an_override_that_hydra_reads():
    parser = OverridesParser.create()
    for grid in (TABLES | FIGURES).values():
        for run in grid.runs((0,)):
            parser.parse_overrides(run)
