"""The report as a document: its values and its JSON file."""

import dataclasses
import json
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torchrl.envs import GymEnv, TransformedEnv

from tests.residuals.report.made_up_reports import (
    DATA,
    few_pictures,
    full_report,
    no_conclusion,
    nothing_missing,
    trace,
    windowed,
)
from torchrl_h2o.data import DataError
from torchrl_h2o.effects import (
    ActionBias,
    ActionGain,
    BodyMass,
    Effect,
    Gravity,
    JointForce,
    JointFrictionLoss,
    ObservationBias,
    ResidualForce,
    paper_gap,
)
from torchrl_h2o.envs import DynamicsGap, WheelLeggedEnv, mujoco_model
from torchrl_h2o.residuals.progress import EFFECTS, OTHERS
from torchrl_h2o.residuals.report.contents import (
    EXPLAINED,
    FoundEffect,
    IndistinguishableGroup,
    RejectedEffect,
    Verdict,
)
from torchrl_h2o.residuals.report.document import Report
from torchrl_h2o.residuals.report.errors import ErrorSummary, PredictedRow, Prediction, PredictionTable
from torchrl_h2o.residuals.report.words import effect_units, effect_words, interval

NUMBERS = st.floats() | st.sampled_from([math.nan, math.inf, -math.inf])


def same(value, other):
    """Equality in which NaN equals NaN, also within dataclasses."""
    if isinstance(value, float) and isinstance(other, float):
        return value == other or (math.isnan(value) and math.isnan(other))
    if dataclasses.is_dataclass(value):
        return type(value) is type(other) and all(
            same(getattr(value, field.name), getattr(other, field.name)) for field in dataclasses.fields(value)
        )
    if isinstance(value, dict):
        return value.keys() == other.keys() and all(same(value[key], other[key]) for key in value)
    if isinstance(value, tuple):
        return type(other) is tuple and len(value) == len(other) and all(map(same, value, other))
    return value == other


def without_trace(report):
    return dataclasses.replace(report, trace=None)


def test_names_without_a_conclusion_are_refused():
    with pytest.raises(ValueError, match="no conclusion"):
        dataclasses.replace(full_report(), conclusion="7 rows are too few")


def test_a_group_needs_an_error_for_each_effect():
    with pytest.raises(ValueError, match="2 effects has 1 errors"):
        IndistinguishableGroup((Gravity(2.0), ActionGain(2.0)), (0.1,))


def test_the_effects_of_a_report_make_a_dynamics_gap():
    assert DynamicsGap(*full_report().effects).effects == full_report().effects


@pytest.mark.parametrize("value", [1.56676, -1.56676])
def test_a_value_rounded_for_reading_stays_within_its_bounds(value):
    @dataclasses.dataclass(frozen=True)
    class Narrow(Gravity):
        scale: float = dataclasses.field(
            default=0.0, metadata={"unit": "1", "bounds": (-1.56676, 1.56676), "neutral": 0.0}
        )

    assert effect_words(Narrow(value)) == f"gravity × {value:g}"


def test_a_force_made_from_the_residual_is_named_by_its_joint_and_told_in_round_numbers(tmp_path):
    force = ResidualForce(("torque on elbow: 0.412345 · sin(7.00012 q)",))
    report = Report(simulator="a", data=DATA, found=(FoundEffect(force, False, {"coefficient_1": (0.4, 0.42)}, 0.1),))
    assert report.found[0].name == "ResidualForce[elbow]"
    assert report.sentence() == (
        "Your simulator lacks: outside the catalogue: torque on joint elbow: 0.412 N·m · sin(7 q)."
    )
    assert Report.load(report.save(tmp_path)) == report


@given(low=st.floats(-1e6, 1e6), share=st.floats(1e-5, 1.0))
def test_an_interval_in_words_tells_its_ends_apart(low, share):
    high = low + share * max(abs(low), 1e-3)
    start, end = interval(low, high, "1").removeprefix("between ").split(" and ")
    assert start != end


def test_a_saved_report_is_loaded_as_it_was(tmp_path):
    for i, report in enumerate((few_pictures(windowed()), nothing_missing(), no_conclusion())):
        path = report.save(tmp_path / str(i))
        assert {file.name for file in path.parent.iterdir()} == {"report.json", "report.html"}
        for place in (path, path.parent, str(path)):
            loaded = Report.load(place)
            assert loaded.sentence() == report.sentence()
            assert loaded.to_json() == report.to_json()
            assert loaded.effects == report.effects


def test_a_file_of_an_earlier_version_is_loaded():
    entries = windowed().to_json()
    for name in ("windows", "runs", "mended_model"):
        del entries[name]
    assert same(without_trace(Report.from_json(entries)), without_trace(full_report_as_read()))


def full_report_as_read():
    return Report.from_json(full_report().to_json())


def test_windows_runs_and_the_model_are_kept():
    report = windowed()
    read = Report.from_json(json.loads(json.dumps(report.to_json(), allow_nan=False)))
    for name in ("windows", "runs", "mended_model"):
        assert same(getattr(read, name), getattr(report, name))
    assert "Report.load(folder).mended(env)" in report.to_json()["mended_model"]["remedy"]
    assert read.mended_model.effects == (JointFrictionLoss(0.0412, "elbow"),)


def test_the_units_of_a_sliding_joint_are_kept(tmp_path):
    names = {"joints": ["rail"], "joint_bodies": ["cart"], "joint_types": ["slide"]}
    push = JointForce(6.72, "rail")
    found = FoundEffect(push, True, {"torque": (6.5, 6.9)}, 0.1, effect_words(push, names), effect_units(push, names))
    report = Report(simulator="a", data=DATA, found=(found,))
    assert report.to_json()["effects"][0]["parameters"]["torque"]["unit"] == "N"
    loaded = Report.load(report.save(tmp_path))
    assert loaded == report
    assert loaded.sentence() == "Your simulator lacks: constant force of 6.72 N on joints rail."


@pytest.mark.parametrize("make", [lambda: GymEnv("HalfCheetah-v5"), WheelLeggedEnv])
def test_a_report_mends_an_env(make):
    gain = FoundEffect(ActionGain(0.5), True, {}, 0.1)
    report = Report(simulator="a", data=DATA, found=(FoundEffect(Gravity(0.5), True, {}, 0.1), gain))
    own = (Gravity(2.0), ObservationBias(0.1))
    env = report.mended(TransformedEnv(make(), DynamicsGap(*own)))
    by_hand = TransformedEnv(make(), DynamicsGap(*own, *report.effects))
    assert mujoco_model(env).opt.gravity[2] == pytest.approx(-9.81)
    paths = []
    for mended in (env, by_hand):
        mended.set_seed(0)
        torch.manual_seed(0)
        paths.append(mended.rollout(20, break_when_any_done=False)["next", "observation"])
    assert Report(simulator="a", data=DATA).mended(make()).rollout(2).shape == (2,)
    torch.testing.assert_close(*paths)


def test_effects_on_actions_that_would_come_before_those_of_the_env_are_refused():
    report = Report(simulator="a", data=DATA, found=(FoundEffect(ActionGain(0.5), True, {}, 0.1),))
    with pytest.raises(ValueError, match="has to come first"):
        report.mended(TransformedEnv(GymEnv("HalfCheetah-v5"), DynamicsGap(ActionBias(0.1))))


@given(number=NUMBERS, optional=st.none() | NUMBERS, low=NUMBERS)
def test_the_file_is_strict_json_and_reads_back_what_it_was_given(number, optional, low):
    full = without_trace(full_report())
    dimension = dataclasses.replace(full.error.per_dimension[0], before=number, floor=optional)
    horizon = dataclasses.replace(full.error.horizons[0], after={dimension.name: number})
    report = dataclasses.replace(
        full,
        found=(FoundEffect(Gravity(2.0), False, {"scale": (low, number)}, number),),
        rejected=(RejectedEffect(paper_gap("soft_feet"), number, optional, "diverges"),),
        indistinguishable=(IndistinguishableGroup((Gravity(2.0), BodyMass(1.5)), (number, low)),),
        error=ErrorSummary("RMSE", "1", low, number, optional, (dimension,), (horizon,)),
        predictions=PredictionTable(0.1, (PredictedRow("total", *[Prediction(number, low, number)] * 4),)),
        wall_s=optional,
    )
    text = json.dumps(report.to_json(), allow_nan=False)
    assert same(Report.from_json(json.loads(text)), expected(report))


def expected(value):
    """The report as JSON keeps it: floats that are not finite are NaN, or None in optional fields."""
    if isinstance(value, float):
        return value if math.isfinite(value) else math.nan
    if isinstance(value, dict):
        return {key: expected(entry) for key, entry in value.items()}
    if isinstance(value, tuple):
        return tuple(map(expected, value))
    if not dataclasses.is_dataclass(value) or isinstance(value, Effect):
        return value
    kept = {}
    for field in dataclasses.fields(value):
        entry = getattr(value, field.name)
        lost = isinstance(entry, float) and not math.isfinite(entry) and field.type == float | None
        kept[field.name] = None if lost else expected(entry)
    return dataclasses.replace(value, **kept)


def test_the_file_holds_what_a_reader_of_it_looks_for():
    entries = full_report().to_json()
    assert set(entries) == {
        *("sentence", "simulator", "effects", "rejected", "indistinguishable", "error", "predictions"),
        *("unexplained_intervals", "data", "stop_test", "conclusion", "wall_s", "made_by", "trace"),
        *("windows", "runs", "mended_model", "verdict", "failures", "unfinished", "ended_in", "left_out"),
        *("audit", "others", "steps"),
    }
    assert {"name", "declared", "parameters", "error_after"} <= set(entries["effects"][0])
    assert entries["effects"][2]["name"] == "JointFrictionLoss[elbow]"
    assert entries["effects"][2]["declared"] is False
    assert entries["effects"][2]["parameters"] == {"torque": {"value": 0.0412, "unit": "N·m", "ci95": [0.0391, 0.0433]}}
    assert {"metric", "before", "after", "floor", "per_dimension", "horizons"} <= set(entries["error"])
    assert set(entries["predictions"]) == {"seconds", "rows"}
    assert {"source", "transitions", "held_out"} <= set(entries["data"])


def test_numpy_numbers_are_written_as_numbers(tmp_path):
    found = FoundEffect(Gravity(2.0), np.True_, {"scale": (np.float32(1.5), np.float64(2.5))}, np.float32(0.25))
    loaded = Report.load(Report(simulator="a", data=DATA, found=(found,), wall_s=np.float64(2.0)).save(tmp_path))
    assert loaded.found[0] == FoundEffect(Gravity(2.0), True, {"scale": (1.5, 2.5)}, 0.25)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ("", "is not a report"),
        ("{", "is not a report"),
        ("[1, 2]", "is not a report"),
        ('{"simulator": "a"}', "it lacks 'effects'"),
    ],
)
def test_a_file_that_is_no_report_is_refused(tmp_path, content, problem):
    path = tmp_path / "report.json"
    path.write_text(content)
    with pytest.raises(DataError, match=problem) as caught:
        Report.load(path)
    assert "report.json" in str(caught.value)


def test_a_report_of_an_effect_that_is_none_is_refused(tmp_path):
    text = json.dumps(full_report().to_json())
    (tmp_path / "report.json").write_text(text.replace("Gravity", "Levity"))
    with pytest.raises(DataError, match="Levity"):
        Report.load(tmp_path)


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        (("runs", 0, "before"), "0.1", r"runs\.0\.before: .* not '0\.1'"),
        (("error", "before"), [1.0], r"error\.before: "),
        (("error", "per_dimension", 0, "after"), "small", r"error\.per_dimension\.0\.after: "),
        (("wall_s",), "long", r"wall_s: "),
        (("verdict", "recommended"), "yes", r"verdict\.recommended: "),
        (("simulator",), 3, r"simulator: "),
        (("effects", 0, "error_after"), "x" * 10_000, r"found\.0\.error_after: "),
    ],
)
def test_text_among_numbers_is_refused_by_name(tmp_path, place, value, said):
    report = dataclasses.replace(windowed(), trace=None, verdict=Verdict(EXPLAINED))
    entries = json.loads(json.dumps(report.to_json()))
    *above, last = place
    part = entries
    for key in above:
        part = part[key]
    part[last] = value
    (tmp_path / "report.json").write_text(json.dumps(entries))
    with pytest.raises(DataError, match=said) as caught:
        Report.load(tmp_path)
    assert len(str(caught.value)) < 300 + len(str(tmp_path))


def test_a_file_with_deeply_nested_lists_is_refused(tmp_path):
    (tmp_path / "report.json").write_text("[" * 200_000)
    with pytest.raises(DataError, match="is not a report"):
        Report.load(tmp_path)


@pytest.mark.parametrize(
    "unfinished", [{"ended_in": EFFECTS}, {"ended_in": OTHERS}, {"unfinished": "effects were tried"}]
)
def test_an_unfinished_report_recommends_its_effects_nowhere(unfinished):
    report = dataclasses.replace(full_report(), verdict=Verdict(EXPLAINED), **unfinished)
    assert not report.recommended
    assert report.to_json()["verdict"]["recommended"] is False
    assert "was not finished" in report.why_not_recommended()
    read = Report.from_json(json.loads(json.dumps({**report.to_json(), "verdict": {"kind": EXPLAINED}})))
    assert not read.verdict.recommended
    finished = dataclasses.replace(full_report(), verdict=Verdict(EXPLAINED))
    assert finished.recommended
    assert finished.to_json()["verdict"]["recommended"] is True


def test_a_part_of_a_report_that_lacks_something_is_named(tmp_path):
    entries = full_report().to_json()
    del entries["data"]["held_out"]
    (tmp_path / "report.json").write_text(json.dumps(entries))
    with pytest.raises(DataError, match="it lacks 'held_out'"):
        Report.load(tmp_path)


def test_a_report_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(DataError, match="cannot be read"):
        Report.load(tmp_path)


def read_again(report):
    return Report.from_json(json.loads(json.dumps(report.to_json())))


def test_the_trace_is_kept_thinned():
    whole = trace(rows=4000)
    whole.before[0, 0] = np.nan
    report = dataclasses.replace(full_report(), trace=whole)
    kept = read_again(report).trace
    thinned = whole.thinned()
    assert len(kept.time) == 1500
    assert (kept.time[0], kept.time[-1]) == (whole.time[0], whole.time[-1])
    assert (kept.names, kept.units) == (whole.names, whole.units)
    np.testing.assert_array_equal(kept.held_out, thinned.held_out)
    for name in ("time", "before", "after", "states"):
        np.testing.assert_allclose(getattr(kept, name), getattr(thinned, name), rtol=1e-5)


@pytest.mark.parametrize("rows", [0, 1])
def test_a_trace_of_next_to_nothing_is_kept(rows):
    report = dataclasses.replace(full_report(), trace=trace(rows=5000).thinned(rows))
    assert len(read_again(report).trace.time) == rows


def test_a_trace_that_does_not_fit_itself_is_refused():
    whole = trace(rows=100)
    with pytest.raises(ValueError, match=r"before has the shape \(100, 3\)"):
        dataclasses.replace(whole, before=whole.before[:, :3])
    with pytest.raises(ValueError, match="4 names and 1 units"):
        dataclasses.replace(whole, units=("rad",))
    with pytest.raises(ValueError, match="time decreases"):
        dataclasses.replace(whole, time=whole.time[::-1])


def test_an_undeclared_effect_is_marked_in_words_and_a_declared_one_is_not():
    effect = JointFrictionLoss(0.1)
    assert FoundEffect(effect, True, {}, 0.1).words == effect.describe()
    assert FoundEffect(effect, False, {}, 0.1).words == f"outside the catalogue: {effect.describe()}"


def test_a_window_has_one_value_per_time():
    window = windowed().windows[0]
    with pytest.raises(ValueError, match="elbow angle has 6 measured values at 5 times"):
        dataclasses.replace(window, ahead=window.ahead[1:])
