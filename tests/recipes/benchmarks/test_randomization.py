"""Domain randomisation: the worlds of the trainings, the arm, and runs that are trained once."""

from dataclasses import replace

import cells
import mujoco
import numpy as np
import pandas as pd
import pytest
import randomization
import torch
import training_tables
from machine_series import SERIES, USUAL, WORLDS
from motored_env import ReachingEnv
from options import run_options
from torch.nn.utils import parameters_to_vector

from torchrl_h2o.comparison.records import Record, read_records
from torchrl_h2o.comparison.series_tables import series_tables
from torchrl_h2o.effects import ActionGain, JointDamping, JointFrictionLoss
from torchrl_h2o.residuals import Report
from torchrl_h2o.residuals.report.contents import DataSummary, FoundEffect
from torchrl_h2o.training.preprocessing import Preprocessing
from torchrl_h2o.training.randomisation import usual_world

SMALL = ["logs=1", "rows=50", "worlds=2", "machines=2", "updates=2", "updates_per_epoch=2", "steps_per_epoch=40"]
MACHINE = """
<mujoco model="machine">
  <default><joint axis="0 1 0"/><geom type="sphere" size="0.1"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1"/>
    <body name="arm" pos="0 0 1">
      <joint name="damped" damping="0.2" frictionloss="0.3" armature="0.4"/>
      <geom name="arm" mass="2"/>
      <body name="hand" pos="0 0 0.3">
        <joint name="ideal"/>
        <geom name="hand" mass="1" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="damped"/><motor name="weak" joint="ideal"/></actuator>
</mujoco>
"""
FIELDS = ("body_mass", "dof_damping", "dof_frictionloss", "dof_armature")


def report_of(effect, **ci95):
    return Report(simulator="arm", data=DataSummary("log", 100, 30), found=(FoundEffect(effect, True, ci95, 0.0),))


def world(spec, effects):
    spec = spec.copy()
    for effect in effects:
        if not isinstance(effect, ActionGain):
            effect.edit(spec)
    return spec.compile()


def test_usual_worlds_differ_within_a_fifth_in_each_number_and_keep_zeros():
    spec, rng = mujoco.MjSpec.from_string(MACHINE), np.random.default_rng(0)
    plain = spec.compile()
    drawn = [usual_world(plain, rng, USUAL) for _ in range(50)]
    models = [world(spec, effects) for effects in drawn]
    gains = [[effect.scale for effect in effects if isinstance(effect, ActionGain)] for effects in drawn]
    numbers = np.array(
        [[*(one for field in FIELDS for one in getattr(model, field)), *model.geom_friction[:2, 0]] for model in models]
    )
    nominal = [*(one for field in FIELDS for one in getattr(plain, field)), *plain.geom_friction[:2, 0]]
    changed = np.flatnonzero(nominal)
    shares = np.hstack([numbers[:, changed] / np.take(nominal, changed), gains])
    assert shares.shape == (50, 2 + 3 + 2 + 2)
    assert (np.abs(shares - 1.0) <= 0.2 + 1e-9).all()
    assert (shares.min(0) < 0.85).all()
    assert (shares.max(0) > 1.15).all()
    assert np.abs(np.corrcoef(shares.T) - np.eye(9)).max() < 0.6  # each number is drawn by itself
    assert (np.delete(numbers, changed, 1) == 0.0).all()


@pytest.mark.parametrize("name", SERIES)
def test_machines_scatter_around_what_the_simulator_lacks_and_a_stream_repeats_them(name):
    series = SERIES[name]
    assert series.machines(2, 0.0, stream=0) == [series.missing] * 2
    machines = series.machines(200, 0.1, stream=0)
    assert machines == series.machines(200, 0.1, stream=0)
    assert not set(machines) & set(series.machines(200, 0.1, stream=1))
    for place, mean in enumerate(series.missing):
        (size, *_) = mean.parameters.values()
        (name, *_) = mean.parameters
        away = [m[place].parameters[name].value - size.neutral for m in machines]
        assert np.mean(away) == pytest.approx(size.value - size.neutral, rel=0.03)
        assert np.std(away) == pytest.approx(0.1 * abs(size.value - size.neutral), rel=0.2)


def test_a_policy_trains_in_the_worlds_that_its_condition_names():
    arm = SERIES["arm"]
    machines = arm.machines(30, 0.2, stream=3)
    report = report_of(JointDamping(-0.05, joints="elbow"), damping=(-0.25, 0.15))
    drawn = {name: make(arm, report, machines, 0) for name, make in WORLDS.items()}
    assert all(len(worlds) == 30 for worlds in drawn.values())
    assert drawn["mended"] == [report.effects] * 30
    assert drawn["unmended"] == [()] * 30
    assert drawn["the series itself"] == machines
    damping = [effect.damping for (effect,) in drawn["measured ranges"]]
    assert min(damping) >= -0.1  # the elbow's own, of which no draw takes more
    assert damping.count(-0.05) > 1  # the best value, in place of draws that the model rejects
    assert len(set(damping)) > 10
    assert len(set(drawn["± 20 %"])) == 30
    assert drawn["measured ranges"] != WORLDS["measured ranges"](arm, report, machines, 1)


def test_worlds_of_the_arm_step_as_its_task_does():
    arm, task = SERIES["arm"], ReachingEnv()
    env = arm.env([(), ()], Preprocessing())
    state = env.reset()
    task.reset()
    for _ in range(3):
        before = env.base_env.states.copy()
        state = env.step(env.rand_action(state))
        mujoco.mj_setState(task.model, task.data, before[1], mujoco.mjtState.mjSTATE_FULLPHYSICS)
        observation, reward, terminated, *_ = task.step(state["action"][1].numpy())
        np.testing.assert_allclose(state["next", "observation"][1], observation, rtol=1e-5)
        assert state["next", "reward"][1].item() == pytest.approx(reward)
        assert not terminated
        state = env.step_mdp(state)


def test_the_arm_is_rewarded_by_the_distance_of_its_tip():
    arm = ReachingEnv()
    arm.set_state(np.array([0.3, -0.9]), np.zeros(2))
    lower = arm.data.body("lower")
    tip = lower.xpos + lower.xmat.reshape(3, 3) @ [0.0, 0.0, -0.3]
    assert arm.distance(arm.data.qpos) == pytest.approx(np.linalg.norm(tip[[0, 2]] - arm.target))


def test_policies_of_one_seed_begin_alike_and_learn_from_their_own_worlds():
    arm, preprocessing = SERIES["arm"], Preprocessing()
    logs = arm.logs([arm.missing], 50, 0.0)
    cfg = run_options("method=sac", *arm.options, *SMALL[-3:], "batch_size=[8,8]")
    envs = [arm.env(worlds, preprocessing) for worlds in ([()], [arm.missing], [()])]
    torch.manual_seed(0)
    first, other, later = randomization.train(envs, [0, 0, 1], logs, preprocessing, cfg)
    cfg.updates = 0
    (untrained,) = randomization.train([arm.env([()], preprocessing)], [0], logs, preprocessing, cfg)
    weights = [parameters_to_vector(policy.parameters()) for policy in (first, other, later, untrained)]
    moved = [(one - weights[3]).abs().max() for one in weights[:3]]
    assert 0.0 < moved[0] < 0.02  # two steps of Adam
    assert 0.0 < moved[1] < 0.02
    assert not torch.equal(weights[0], weights[1])
    assert moved[2] > 0.02  # another seed, another start


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Runs the script with small budgets and a report that no search has found; lists the trained policies."""
    trained = []
    monkeypatch.setattr(randomization, "SERIES", {"arm": replace(SERIES["arm"], episode=20)})
    monkeypatch.setattr(randomization, "close_the_loop", lambda *args, **kwargs: report_of(JointFrictionLoss(0.3)))
    train = randomization.train

    def noted(envs, seeds, *args):
        trained.append(len(envs))
        return train(envs, seeds, *args)

    monkeypatch.setattr(randomization, "train", noted)

    def call(*options):
        argv = ["randomization.py", "series=[arm]", "seeds=[0]", f"folder={tmp_path}", *SMALL, *options]
        monkeypatch.setattr("sys.argv", argv)
        randomization.main()
        return trained

    return call


def test_a_policy_is_trained_once_and_what_is_missing_is_trained_again(run, tmp_path, capsys):
    two = "worlds_of=[measured ranges,unmended]"
    assert run(two) == [2]
    records = list(read_records(tmp_path, "randomization"))
    assert {record.values["worlds"] for record in records} == {"measured ranges", "unmended"}
    assert all(len(record.values["returns"]) == 2 for record in records)
    printed = capsys.readouterr().out
    assert printed.count("\n| ") == 2 + 2
    assert "The return with measured ranges is " in printed
    assert run(two) == [2]
    (tmp_path / "randomization" / "arm_unmended_2_updates_seed0.json").unlink()
    assert run(two, "seeds=[0,1]") == [2, 3]
    assert len(list(read_records(tmp_path))) == 4


def test_runs_with_other_options_do_not_mix_in_a_folder(run):
    run("worlds_of=[unmended]")
    with pytest.raises(ValueError, match=r"options.yaml has other options"):
        run("scatter=0.1")


def test_the_page_shows_the_lines_and_scores_that_the_benchmark_records():
    assert tuple(WORLDS) == training_tables.WORLDS
    assert {series.score[0] for series in SERIES.values()} <= set(training_tables.SCORES)
    made_by = {"commit": "abc1234", "instruction_set": "AVX2", "cpu_s": 60.0}
    told = {"series": "arm", "updates": 8000, "worlds": ["unmended"] * 2 + ["measured ranges"] * 2, "seed": [0, 1] * 2}
    returns = {"return": [1.0, 2.0, 3.0, 5.0]}
    rows = pd.DataFrame(told | returns).to_dict("records")
    runs = [Record("randomization", "", made_by, row) for row in rows]
    page = training_tables.randomization_table({"randomization": cells.frame(runs)})
    assert page.index("| measured ranges | 4 [3, 5] | 2 |") < page.index("| unmended | 1.5 [1, 2] | 2 |")
    assert "higher than with unmended (by 2.5 [2, 3])." in page
    assert "abc1234" in page
    assert training_tables.randomization_table({}) == cells.NOT_RUN


@pytest.mark.parametrize(
    ("returns", "said"),
    [
        ([1.0, 2.0, 2.7], "not distinguishable from that with b"),
        ([1.3, 2.0, 3.0], "not distinguishable from that with b"),
        ([1.0, 1.5, 1.7], "is lower than with b"),
        ([3.0, 2.5, 2.3], "is higher than with b"),
    ],
)
def test_a_difference_that_chance_explains_is_not_called_one(returns, said):
    told = {"series": "arm", "updates": 8000, "worlds": list("aaabbb"), "seed": [0, 1, 2] * 2}
    runs = pd.DataFrame(told | {"return": [*returns, 2.0, 2.0, 2.0]})
    assert said in series_tables(runs, ["a", "b"], ["return"])


def test_policies_of_another_budget_have_a_table_of_their_own():
    told = {"series": "arm", "updates": [8000, 16_000], "worlds": "a", "seed": 0, "return": [1.0, 3.0]}
    tables = series_tables(pd.DataFrame(told), ["a"], ["return"])
    assert tables.index("8,000 updates") < tables.index("| 1 [1, 1] |") < tables.index("16,000 updates")
