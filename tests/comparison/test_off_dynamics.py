"""The table of the off-dynamics files: which runs it has, and how their scores are arranged."""

import pandas as pd
import pytest

from tests.composed import composed
from torchrl_h2o.comparison.grids import (
    OFF_DYNAMICS_FILES,
    OFF_DYNAMICS_METHODS,
    OffDynamicsGrid,
    chosen_grid,
    env_of_file,
)
from torchrl_h2o.comparison.off_dynamics import markdown, points_of
from torchrl_h2o.comparison.results_file import IDENTITY, RESULT
from torchrl_h2o.comparison.scores import REFERENCES, MixedRunsError
from torchrl_h2o.comparison.tables import report_off_dynamics

FIRST, SECOND = OFF_DYNAMICS_FILES[:2]


@pytest.fixture
def folder(tmp_path):
    for file in OFF_DYNAMICS_FILES:
        (tmp_path / f"{file}.hdf5").touch()
    return tmp_path


def grid_of(folder, *overrides):
    return chosen_grid(composed("paper", "table=off_dynamics", f"folder_of_data={folder}", *overrides))


def test_the_first_seed_and_the_files_with_half_of_the_gravity_come_first(folder):
    runs = list(grid_of(folder).runs((0, 1)))
    assert len(OFF_DYNAMICS_FILES) == 18
    assert len(runs) == 2 * (18 * 6 + 6)  # SAC reads no data
    assert [run[-1] for run in runs] == ["seed=0"] * 114 + ["seed=1"] * 114
    assert runs[0][:3] == ["method=h2o_plus", "env=walker2d_gravity", f"data={folder}/walker2d_gravity_0.5_expert.hdf5"]
    assert all("gravity" in run[1] for run in runs[: 6 * 6 + 2])


def test_only_the_mended_runs_have_the_options_of_the_first_command(folder):
    runs = list(grid_of(folder, "tasks=[walker2d_morph_medium]").runs((0,)))
    mended = [run for run in runs if "mend=true" in run]
    assert [run[0] for run in mended] == ["method=h2o_plus", "method=sac"]
    assert all({"warm_start=true", "keep=best_in_simulator"} <= set(run) for run in mended)
    assert all(len(run) == 4 for run in runs if run not in mended)


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["tasks=[walker2d_gravity]"], r"tasks=\[walker2d_gravity\]: choose walker2d_gravity_0.5_expert"),
        (["methods=[cql]"], r"methods=\[cql\]: choose h2o_plus_mended"),
        (["gaps=[gravity]"], "so gaps would have no effect"),
        (["folder_of_data=null"], "needs the folder"),
        (["table=methods", "tasks=[mine]"], "methods has no folder of data"),
        (["figure=backbones", "table=null"], "backbones has no folder of data"),
    ],
)
def test_a_choice_that_there_is_not_is_said_before_anything_runs(folder, overrides, said):
    with pytest.raises(ValueError, match=said):
        grid_of(folder, *overrides)


def test_a_file_that_is_missing_is_said_before_anything_runs(folder):
    (folder / f"{SECOND}.hdf5").unlink()
    with pytest.raises(ValueError, match=f"it has no {SECOND}.hdf5"):
        grid_of(folder)
    assert isinstance(grid_of(folder, f"tasks=[{FIRST}]"), OffDynamicsGrid)


def row(method, seed, score, file=FIRST, **others):
    low, high = REFERENCES[env_of_file(file)]
    told = {"method": method.removesuffix("_mended"), "mend": "true" if method.endswith("_mended") else ""}
    told |= {"env": env_of_file(file), "data": f"off_dynamics/{file}.hdf5", "seed": str(seed), "updates": "20000"}
    return (
        dict.fromkeys((*IDENTITY, *RESULT), "") | told | {"return_mean": str(low + score * (high - low) / 100)} | others
    )


def rows(mended, others, file=FIRST):
    return [
        row(method, 0, mended if method == "h2o_plus_mended" else others, file)
        for method in OFF_DYNAMICS_METHODS
        if method != "sac" or file == FIRST
    ]


def test_scores_stand_by_file_and_method_and_the_mended_simulator_is_counted():
    told = [*rows(85.0, 40.0), *rows(30.0, 60.0, SECOND), row("sac", 0, 10.0, SECOND), row("h2o_plus_mended", 1, 95.0)]
    text = markdown(points_of(pd.DataFrame(told)))
    (line,) = [line for line in text.splitlines() if line.startswith(f"| {FIRST}")]
    assert "| 90.0 ± 7.1 (2) | 40.0 (1) |" in line
    assert "beats the best of the others in 1 of 2 files; H2O+ in the mended simulator alone in 1." in text
    assert "The better one scores 80 or more in 1 of 2 files with half of the gravity" in text
    assert "online source, offline target" in text


def test_sac_stands_in_the_files_of_its_change_and_a_file_without_all_methods_is_not_counted():
    text = markdown(points_of(pd.DataFrame(rows(85.0, 40.0))))
    lines = [line for line in text.splitlines() if line.startswith("| walker2d_gravity")]
    assert [line.count("40.0 (1)") for line in lines] == [6, 1, 1]  # of the last two, SAC's
    assert "in 1 of 1 files" in text


def test_a_run_that_diverged_is_said_and_budgets_are_not_mixed(tmp_path):
    told = [*rows(85.0, 40.0)[1:], row("h2o_plus_mended", 0, 0.0, return_mean="")]
    report_off_dynamics(pd.DataFrame(told), tmp_path)
    text = (tmp_path / "off_dynamics.md").read_text()
    assert "diverged in 1 of 1" in text
    assert "After 20,000 updates." in text
    with pytest.raises(MixedRunsError, match="differ in updates"):
        points_of(pd.DataFrame([*told, row("iql", 1, 40.0, updates="200000")]))
    with pytest.raises(MixedRunsError):
        points_of(pd.DataFrame([*told, row("iql", 0, 40.0)]))
