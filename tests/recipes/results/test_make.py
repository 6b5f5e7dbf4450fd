"""The tables of stored runs: they come from one commit, and each run is stored without folders of the machine."""

import json

import make
import pytest
from running import FAMILIES

from torchrl_h2o.comparison.records import Record, read_records

MADE_BY = {"commit": "abc1234", "dirty": False, "cpu_s": 120.0, "versions": {}, "threads": 1, "instruction_set": "AVX2"}


def drawn(family, number, ok, seed=0, **made_by):
    values = {"family": family, "number": number, "seed": seed, "ok": ok, "name": "", "truth": "mass", "found": "gain"}
    return Record("drawn", f"{family}_{number}_{seed}", MADE_BY | made_by, values)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "page.md").write_text("# Page\n<!-- table: drawn -->\nold\n<!-- end -->\nafter\n")
    return tmp_path


def saved(folder, *records):
    for record in records:
        record.save(folder / "runs")


def test_draws_that_chose_something_are_counted_apart_with_their_intervals(folder):
    held = [drawn("slow", number, ok=number != 9) for number in (6, 8, 9)]
    saved(
        folder, *held, drawn("slow", 6, ok=True, seed=1), drawn("slow", 0, ok=True), drawn("slow", 0, ok=False, seed=1)
    )
    assert make.make(folder) == ["page.md"]
    page = (folder / "page.md").read_text()
    (line,) = [line for line in page.splitlines() if line.startswith("| `slow`")]
    # by Wilson's formula: 3 of 5 is [23, 88 %], 1 of 1 is [21, 100 %]
    assert "| 3 of 5 [23, 88 %] | 1 of 1 [21, 100 %] | 6 | 2 | abc1234 |" in line
    assert "| `decoy` " in page
    assert "not run on this code" in page
    assert page.startswith("# Page\n")
    assert page.endswith("<!-- end -->\nafter\n")
    assert make.make(folder, check=True) == []


def test_values_inside_intervals_are_summed_over_the_series_of_a_machine(folder):
    (folder / "page.md").write_text("<!-- table: coverage -->\n<!-- end -->\n")
    told = {"machine": "arm", "asked": 5, "values": 4, "inside": 2, "inside_widened": 3}
    told |= {"truths": 4, "truths_inside": 4}
    unknown = told | {"machine": "real", "truths": 0, "truths_inside": 0}
    saved(folder, *(Record("coverage", name, MADE_BY, one) for name, one in (("a", told), ("b", told), ("c", unknown))))
    make.make(folder)
    page = (folder / "page.md").read_text()
    assert "| arm | 2 | 8 of 10 | 4 of 8 [22, 78 %] | 6 of 8 [41, 93 %] | 8 of 8 [68, 100 %] | 2 | abc1234 |" in page
    assert "| real | 1 | 4 of 5 | 2 of 4 [15, 85 %] | 3 of 4 [30, 95 %] |  | 2 | abc1234 |" in page


def rounds(folder, seed, measured, **others):
    """The folder of a finished sim_to_real.py, whose first return is inside the prediction, and its second is not."""
    told = {"env": "robot", "gap": None, "method": "h2o_plus", "mend": "posterior", "randomise": 0.0, "seed": seed}
    told["rounds"] = [
        {"seconds": 2.5 + 10.0 * number, "measured": value, "inside": number == 0}
        for number, value in enumerate(measured)
    ]
    (folder / str(seed)).mkdir(parents=True)
    (folder / str(seed) / "rounds.json").write_text(json.dumps(told | MADE_BY | others))
    return folder / str(seed)


def test_rounds_of_several_seeds_become_a_line_and_a_figure(folder):
    (folder / "page.md").write_text("<!-- table: rounds -->\n<!-- end -->\n")
    for seed, measured in enumerate(((1.0, 50.0), (3.0, 60.0), (2.0, 70.0))):
        saved(folder, *make.records_of(rounds(folder / "runs_of_sim_to_real", seed, measured)))
    saved(folder, *make.records_of(rounds(folder / "sac", 0, (4.0, 5.0), method="sac", mend=False, randomise=0.2)))
    make.make(folder)
    make.draw(folder)
    page = (folder / "page.md").read_text()
    assert "| H2O+, mended | 2 | 60 | 12.5 | 3 of 6 | 3 |" in page
    assert "| SAC, ± 20 % | 4 | 5 | 12.5 | 1 of 2 | 1 |" in page
    assert (folder / "sim_to_real.png").stat().st_size > 10_000


@pytest.mark.parametrize("other", [{"commit": "def5678"}, {"dirty": True}, {"dirty": None}])
def test_rows_of_different_code_make_no_table(folder, other):
    saved(folder, drawn("slow", 4, ok=True), drawn("slow", 6, ok=True, **other))
    before = (folder / "page.md").read_text()
    with pytest.raises(ValueError, match=r"(?s)drawn slow: its rows must come from one commit.*slow_6_0"):
        make.make(folder)
    assert (folder / "page.md").read_text() == before


def test_families_of_drawn_cases_may_be_of_different_commits(folder):
    saved(folder, drawn("slow", 4, ok=True), drawn("decoy", 0, ok=True, commit="def5678"))
    make.make(folder)
    lines = (folder / "page.md").read_text().splitlines()
    commits = {name: line.split("|")[-2].strip() for line in lines for name in ("slow", "decoy") if f"`{name}`" in line}
    assert commits == {"slow": "abc1234", "decoy": "def5678"}


def test_a_marker_of_no_table_is_refused(folder):
    (folder / "page.md").write_text("<!-- table: drwan -->\n<!-- end -->\n")
    with pytest.raises(ValueError, match=r"page.md: there is no table drwan; choose from"):
        make.make(folder)


def report_of(*effects, **others):
    verdict = {"kind": "explained", "recommended": True}
    told = {"unfinished": None, "made_by": MADE_BY, "effects": list(effects), "verdict": verdict, "audit": None}
    return told | {"others": [], "sentence": "", "ended_in": None, "wall_s": 1.0} | others


def friction(value, joint, interval=None):
    effect = {"effect": "JointFrictionLoss", "frictionloss": value, "joints": joint}
    parameters = {"frictionloss": {"value": value, "unit": "N·m", "ci95": interval}}
    return {"effect": effect, "parameters": parameters, "words": f"dry friction of {joint}"}


def test_found_values_stand_beside_the_known_ones(tmp_path):
    run = tmp_path / "double_pendulum"
    run.mkdir()
    found = [friction(0.1, "*", [0.09, 0.11]), friction(0.05, "shoulder"), friction(0.02, "ankle")]
    (run / "report.json").write_text(json.dumps(report_of(*found)))
    (record,) = make.records_of(run)
    assert (record.table, record.name) == ("machines", "double_pendulum")
    table = make.tables_of([record])["machines"]
    assert "| 0.15: right, 3 % off | explained | 2 | abc1234 | yes |" in table  # 0.146 N·m known; found as a sum
    assert "| 0.1 [0.09, 0.11]: right, 18 % off |" in table  # 0.122 N·m at the elbow
    assert "| not found |" in table  # the rotor
    assert "| *besides* | dry friction of ankle |" in table


@pytest.mark.parametrize("name", ["unknown_machine", "double_pendulum"])
def test_reports_that_cannot_be_placed_are_refused(tmp_path, name):
    (tmp_path / name).mkdir()
    (tmp_path / name / "report.json").write_text(json.dumps(report_of(unfinished="search")))
    with pytest.raises(ValueError, match="not finished" if name == "double_pendulum" else "machines.yaml"):
        make.records_of(tmp_path / name)
    with pytest.raises(ValueError, match=r"has no report.json, summary.json or records"):
        make.records_of(tmp_path)


def test_records_have_no_folder_of_the_machine(tmp_path):
    told = {"found": "failed: no file /home/me/logs/a.txt", "rates": [1.0], "unit": "N·m/rad"}
    path = Record("drawn", "a", MADE_BY, told).save(tmp_path)
    assert "/home" not in path.read_text()
    (record,) = read_records(tmp_path)
    assert record.values == told | {"found": "failed: no file logs/a.txt"}


def test_the_pages_that_ship_are_those_that_the_stored_runs_make():
    assert make.make(make.HERE, check=True) == []


def test_the_families_of_the_page_are_those_of_the_benchmark():
    told = {name: family["draws"] for name, family in make.cells.drawn_families().items()}
    assert told == {name: family.size for name, family in FAMILIES.items()}
    assert all(draw < told[name] for name, family in make.cells.drawn_families().items() for draw in family["chose"])


def test_the_files_of_a_benchmark_of_others_stand_with_what_was_found_and_what_it_leaves(folder):
    tables = [f"<!-- table: {name} -->\n<!-- end -->\n" for name in ("off_dynamics", "off_dynamics_errors")]
    (folder / "page.md").write_text("".join(tables))
    near, far = [0.001] * 9, [0.25] * 9
    told = {"file": "walker2d_gravity_0.5_expert", "change": "gravity × 0.5", "found": "gravity × 0.49"}
    told |= {"verdict": "explained_in_part", "recommended": True, "unmodified": far, "mended": near, "changed": near}
    told |= {"reward_error": 0.002, "other_terminations": 2}
    other = told | {"file": "walker2d_morph_medium", "found": "body mass × 2", "recommended": False, "mended": far}
    one_velocity_off = [*near[:-1], 0.002]
    worse = told | {"file": "walker2d_kinematic_expert", "mended": one_velocity_off}  # recommended all the same
    saved(folder, *(Record("off_dynamics", one["file"], MADE_BY, one) for one in (told, other, worse)))
    make.make(folder)
    page = (folder / "page.md").read_text()
    assert "| walker2d_gravity_0.5_expert | gravity × 0.5 | gravity × 0.49 | explained in part |  |" in page
    assert "| body mass × 2 | explained in part; not recommended |" in page
    assert "| walker2d_gravity_0.5_expert | 0.25 | 0.001 | 0.001 | 0.25 | 0.001 | 0.001 | 0.002 | 2 |" in page
    assert "Searches of commit abc1234." in page
    assert "beats the best" not in page  # there are no scores
    assert "1 of 3 simulators mended exactly" in make.tables_of(list(read_records(folder / "runs")))["overview"]
