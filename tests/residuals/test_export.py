"""Ranges for domain randomisation in other projects: their values, what changes together, and that they read back."""

import ast
import csv
import importlib.util
import json
import sys
import types

import mujoco
import numpy as np
import pytest
import torch

from torchrl_h2o.effects import (
    ActionDelay,
    Armature,
    BodyInertia,
    BodyMass,
    Gravity,
    JointDamping,
    JointFrictionLoss,
    LoadFriction,
    ObservationBias,
    Payload,
    Pipeline,
    ServoStiffness,
    StribeckFriction,
)
from torchrl_h2o.effects.states import States
from torchrl_h2o.options.sources import require_folder
from torchrl_h2o.residuals import Report, Simulation
from torchrl_h2o.residuals.report.contents import DataSummary, FoundEffect
from torchrl_h2o.residuals.report.export import export
from torchrl_h2o.residuals.report.ranges import model_ranges

MODEL = """<mujoco><worldbody><body name="upper"><joint name="hip" axis="0 1 0" damping="0.1"/>
  <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="1"/>
  <body name="lower" pos="0 0 -0.3"><joint name="knee" axis="0 1 0" damping="0.1"/>
  <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.2" mass="0.5"/></body></body></worldbody>
  <actuator><position name="hip_servo" joint="hip" kp="20"/>
  <position name="knee_servo" joint="knee" kp="20"/></actuator>
</mujoco>"""


@pytest.fixture
def simulation(tmp_path):
    (tmp_path / "leg.xml").write_text(MODEL)
    return Simulation.from_mjcf(tmp_path / "leg.xml", ["hip", "hip_velocity"], 0.01)


def report(*found):
    parts = [FoundEffect(effect, declared=True, ci95=ci95, error_after=0.01) for effect, ci95 in found]
    return Report(simulator="leg", data=DataSummary("log.csv", 5000, 1500), found=tuple(parts))


FOUND = (
    (JointDamping(0.2, "*"), {"damping": (0.1, 0.3)}),
    (JointFrictionLoss(0.05, "knee"), {"torque": (0.04, 0.06)}),
    (Armature(0.01, "hip"), {"inertia": (0.008, 0.012)}),
    (BodyMass(1.2, "lower"), {"scale": (1.1, 1.3)}),
    (ServoStiffness(0.9), {"scale": (0.8, 1.0)}),
    (ActionDelay(0.005), {"delay": (0.004, 0.006)}),
    (Gravity(0.98), {"scale": (0.97, 0.99)}),
)


def test_ranges_are_those_of_the_model_s_numbers(simulation):
    found = {(one.field, one.element, one.index): one for one in model_ranges(report(*FOUND), simulation)}
    damping = found["dof_damping", "knee", (1,)]
    assert (damping.nominal, damping.mended) == pytest.approx((0.1, 0.3))
    assert (damping.low, damping.high) == pytest.approx((0.2, 0.4), abs=0.02)
    mass = found["body_mass", "lower", (2,)]
    assert (mass.nominal, mass.mended) == pytest.approx((0.5, 0.6))
    assert (mass.low, mass.high) == pytest.approx((0.55, 0.65), abs=0.01)
    assert ("dof_frictionloss", "hip", (0,)) not in found
    assert ("dof_armature", "hip", (0,)) in found


def test_numbers_of_one_cause_are_of_one_group(simulation):
    found = {(one.field, one.element): one for one in model_ranges(report(*FOUND), simulation)}
    gain, bias = found["actuator_gainprm", "hip_servo"], found["actuator_biasprm", "hip_servo"]
    assert gain.group == bias.group == found["actuator_gainprm", "knee_servo"].group
    assert gain.ends == pytest.approx([-end for end in bias.ends])  # the stiffness stands in both
    assert found["body_mass", "lower"].group == found["body_inertia", "lower"].group
    groups = {
        found[key].group for key in (("dof_damping", "hip"), ("dof_frictionloss", "knee"), ("body_mass", "lower"))
    }
    assert len(groups) == 3


def test_nothing_is_written_of_what_no_effect_changes(simulation):
    assert model_ranges(report((ActionDelay(0.005), {"delay": (0.004, 0.006)})), simulation) == []


def test_the_files_hold_all_effects(simulation, tmp_path):
    files = {path.name: path for path in export(report(*FOUND), simulation, tmp_path / "out")}
    text = ["ranges.json", "playground.py", "mjlab.py", "isaaclab.py", "joints.csv", "hip.json", "knee.json"]
    assert list(files) == [*text, "mean_000.pt", "config.pt"]
    content = json.loads(files["ranges.json"].read_text())
    outside = {one["kind"]: (one["value"], one["low"], one["high"]) for one in content["outside_the_model"]}
    assert outside == {"ActionDelay": (0.005, 0.004, 0.006), "Gravity": (0.98, 0.97, 0.99)}
    assert {one["element"] for one in content["model"]} == {"hip", "knee", "lower", "hip_servo", "knee_servo"}
    with files["joints.csv"].open() as file:
        rows = {row["joint"]: {key: float(row[key]) for key in row if key != "joint"} for row in csv.DictReader(file)}
    assert (rows["hip"]["damping"], rows["hip"]["armature"], rows["hip"]["delay"]) == pytest.approx((0.3, 0.01, 0.005))
    assert rows["hip"]["friction"] == rows["hip"]["friction low"] == 0.0
    assert rows["knee"]["friction low"] == pytest.approx(0.04, abs=0.003)
    for name in ("playground.py", "mjlab.py", "isaaclab.py"):
        assert "# not here: all actuators late by 0.005 s (delay 0.004 to 0.006)" in files[name].read_text()


def test_the_table_for_playground_gives_possible_models(simulation, tmp_path):
    text = export(report(*FOUND), simulation, tmp_path)[1].read_text()
    tree = {node.targets[0].id: node.value for node in ast.parse(text).body if isinstance(node, ast.Assign)}
    ranges, causes = ast.literal_eval(tree["RANGES"]), ast.literal_eval(tree["CAUSES"])
    model, share = simulation.model, np.random.default_rng(0).uniform(size=causes)
    for field, own in ranges.items():
        for index, (cause, begin, end) in own.items():
            getattr(model, field)[index] = begin + share[cause] * (end - begin)
    assert model.actuator_gainprm[:, 0].tolist() == (-model.actuator_biasprm[:, 1]).tolist()
    assert 0.2 < model.dof_damping[0] == model.dof_damping[1] < 0.4


def load(path):
    spec = importlib.util.spec_from_file_location(path.stem + "_export", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_playground_draws_models(simulation, tmp_path):
    jax = pytest.importorskip("jax")
    mjx = pytest.importorskip("mujoco.mjx")
    module = load(export(report(*FOUND), simulation, tmp_path)[1])
    model = mjx.put_model(simulation.model)
    drawn, axes = module.domain_randomize(model, jax.random.split(jax.random.PRNGKey(0), 5))
    assert drawn.dof_damping.shape == (5, 2)
    assert axes.dof_damping == 0
    assert axes.opt.timestep is None
    assert np.ptp(np.asarray(drawn.dof_damping)[:, 0]) > 0.0
    assert np.asarray(drawn.actuator_gainprm)[:, 0, 0] == pytest.approx(-np.asarray(drawn.actuator_biasprm)[:, 0, 1])


@pytest.mark.parametrize("name", ["mjlab", "isaaclab"])
def test_terms_of_events_have_the_names_and_ranges(simulation, tmp_path, monkeypatch, name):
    """The projects need a GPU's packages, so their constructors are replaced by ones that keep their arguments."""
    path = next(path for path in export(report(*FOUND), simulation, tmp_path) if path.stem == name)

    def record(*args, **kwargs):
        return (*args, kwargs)

    names = types.SimpleNamespace
    functions = type("Functions", (), {"__getattr__": lambda self, function: function})()
    modules = {
        "mjlab.envs.mdp": names(dr=functions),
        "mjlab.managers.event_manager": names(EventTermCfg=record),
        "mjlab.managers.scene_entity_config": names(SceneEntityCfg=record),
        "isaaclab.envs": names(mdp=functions),
        "isaaclab.envs.mdp": functions,
        "isaaclab.managers": names(EventTermCfg=record, SceneEntityCfg=record),
    }
    for module in ("mjlab", "mjlab.envs", "mjlab.managers", "isaaclab"):
        modules.setdefault(module, names())
    modules["isaaclab"] = names(envs=modules["isaaclab.envs"])
    for module, content in modules.items():
        monkeypatch.setitem(sys.modules, module, content)
    events = load(path).events
    terms = [(one["func"], one["params"]) for (one,) in events.values()]
    assert all(one["mode"] == "startup" for (one,) in events.values())
    if name == "mjlab":
        damping = next(params for function, params in terms if function == "joint_damping")
        assert damping["asset_cfg"] == ("robot", {"joint_names": ["hip", "knee"]})
        assert damping["ranges"] == pytest.approx((0.2, 0.4), abs=0.02)
        assert (damping["operation"], damping["shared_random"]) == ("abs", True)
        mass = next(params for function, params in terms if function == "pseudo_inertia")
        assert np.exp(2.0 * np.array(mass["alpha_range"])) == pytest.approx([1.1, 1.3], abs=0.02)
    else:
        joints = {
            function: (params["asset_cfg"][1]["joint_names"], params)
            for function, params in terms
            if "friction_distribution_params" in params or "damping_distribution_params" in params
        }
        names, friction = joints["randomize_joint_parameters"]
        assert names == ["knee"]
        assert friction["friction_distribution_params"] == pytest.approx((0.04, 0.06), abs=0.003)
        names, damping = joints["randomize_actuator_gains"]
        assert names == ["hip", "knee"]
        assert damping["damping_distribution_params"] == pytest.approx((0.2, 0.4), abs=0.02)
        assert "randomize_rigid_body_mass" in dict(terms)


def test_a_delay_of_one_motor_is_in_the_row_of_its_joint(simulation, tmp_path):
    found = report((ActionDelay(0.005, actuators=(1,)), {"delay": (0.004, 0.006)}))
    with export(found, simulation, tmp_path)[4].open() as file:
        delays = {row["joint"]: float(row["delay"]) for row in csv.DictReader(file)}
    assert delays == {"hip": 0.0, "knee": 0.005}


def test_an_inertia_without_its_mass_is_named_where_it_cannot_be_written(simulation, tmp_path):
    export(report((BodyInertia(1.5, "lower"), {})), simulation, tmp_path)
    files = {path.name: path.read_text() for path in tmp_path.glob("*.py")}
    for name in ("mjlab.py", "isaaclab.py"):
        assert "# not here: body_inertia of lower (see ranges.json)" in files[name]
    assert '"body_inertia"' in files["playground.py"]


def test_inertias_are_along_the_axes_of_the_body_without_effects(simulation):
    """A payload beside the axis of a link turns its principal axes, which the exported numbers do not hold."""
    payload = Payload(0.4, x=0.1, z=-0.2, bodies="lower")
    found = {
        one.index: one.mended for one in model_ranges(report((payload, {})), simulation) if one.field == "body_inertia"
    }
    loaded, body = simulation.with_effects(payload).model, 2
    matrices = []
    for model in (simulation.model, loaded):
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, model.body_iquat[body])
        matrices.append(matrix.reshape(3, 3))
    turned = matrices[0].T @ matrices[1]
    expected = np.diag(turned @ np.diag(loaded.body_inertia[body]) @ turned.T)
    assert [found[body, axis] for axis in range(3)] == pytest.approx(expected.tolist())


def test_a_folder_that_cannot_be_made_is_refused_before_the_search(tmp_path):
    (tmp_path / "file").write_text("")
    assert require_folder(str(tmp_path / "new" / "ranges"))
    with pytest.raises(ValueError, match=r"no folder can be made there, because .*file is a file"):
        require_folder(str(tmp_path / "file" / "ranges"))


def exported(tmp_path, simulation, *effects):
    export(report(*((effect, {}) for effect in effects)), simulation, tmp_path / "out")
    return tmp_path / "out"


@pytest.mark.parametrize(
    ("effects", "kind"),
    [
        ((), "m1"),
        ((StribeckFriction(0.03, 0.4, joints="knee"),), "m2"),
        ((LoadFriction(0.07, joints="knee"),), "m3"),
        ((LoadFriction(0.07, joints="knee"), StribeckFriction(0.03, 0.4, 0.05, joints="knee")), "m4"),
        ((LoadFriction(0.07, 0.2, joints="knee"), StribeckFriction(0.03, 0.4, 0.05, joints="knee")), "m5"),
        ((StribeckFriction(0.03, 0.4, motor_square=0.3, weight_square=0.7, joints="knee"),), "m6"),
    ],
)
@pytest.mark.parametrize("command", [0.9, 0.2, -0.9])  # above the weight, below it, in its direction
def test_bam_has_the_friction_of_the_mended_simulator(tmp_path, simulation, effects, kind, command):
    usual = (JointFrictionLoss(0.05, "knee"), Armature(0.01, "knee"))
    folder = exported(tmp_path, simulation, *usual, *effects)
    servo = json.loads((folder / "bam" / "knee.json").read_text())
    assert (servo["model"], servo["armature"], servo["friction_viscous"]) == (kind, 0.01, 0.1)
    model, velocity = simulation.with_effects(*usual, *effects).model, 0.3
    data = mujoco.MjData(model)
    data.qpos, data.qvel[1], data.ctrl = (0.4, 0.7), velocity, (0.0, command)
    values = {"dof_frictionloss": model.dof_frictionloss[None].copy()}
    for variation in Pipeline(effects).variations(model):
        variation.apply(States.of(data), values)
    mujoco.mj_forward(model, data)
    motor = data.qfrc_actuator[1]
    weight = -0.5 * 9.81 * 0.1 * np.sin(data.qpos[0] + data.qpos[1])
    assert friction_of_bam(servo, motor, weight, velocity) == pytest.approx(values["dof_frictionloss"][0, 1])
    assert json.loads((folder / "bam" / "hip.json").read_text())["model"] == "m1"


def friction_of_bam(servo: dict, motor: float, external: float, velocity: float) -> float:
    """Friction of BAM's models (``Model.compute_frictions``), written out from their paper."""
    moving = np.exp(-(abs(velocity / servo.get("dtheta_stribeck", 1.0)) ** servo.get("alpha", 1.0)))

    def load(end: str) -> float:
        if servo["model"] in ("m5", "m6"):
            shares = (servo[f"load_friction_{of}{end}"] for of in ("motor", "external"))
            return abs(sum(share * torque for share, torque in zip(shares, (motor, -external), strict=True)))
        return servo.get(f"load_friction{end or '_base'}", 0.0) * abs(motor - external)

    rest = servo.get("friction_stribeck", 0.0) + load("_stribeck")
    if servo["model"] == "m6" and motor * external < 0.0:
        of, weaker = ("external", external) if abs(external) < abs(motor) else ("motor", motor)
        rest += servo[f"load_friction_{of}_quad"] * weaker**2
    return servo["friction_base"] + load("") + (moving * rest if "friction_stribeck" in servo else 0.0)


def test_pace_reads_the_values_of_the_driven_joints(tmp_path, simulation):
    found = (JointDamping(0.2), JointFrictionLoss(0.05, "knee"), Armature(0.01, "hip"), ActionDelay(0.006))
    folder = exported(tmp_path, simulation, *found, ObservationBias(0.03, (0,)))
    mean, joints = (torch.load(folder / "pace" / name) for name in ("mean_000.pt", "config.pt"))
    assert joints == {"joint_order": ["hip", "knee"]}
    np.testing.assert_allclose(mean, [0.01, 0.0, 0.3, 0.3, 0.0, 0.05, 0.03, 0.0, 3.0], rtol=1e-6)  # steps of 2 ms
