"""Writes what a report leaves open as ranges for domain randomisation in other projects."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import mujoco
import numpy as np

from torchrl_h2o.effects import ActionDelay, Effect, Gravity, GravityTilt, ModelEffect, Timestep
from torchrl_h2o.residuals.report.contents import ReportContents
from torchrl_h2o.residuals.report.sampling import explanations_of, sample
from torchrl_h2o.residuals.report.words import effect_words
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.whole_file import write_text

DRAWS = 400  # of Report.sample, from which ranges are taken
LEVELS = (0.025, 0.975)  # of the ranges' ends
ALIKE = 0.02  # relative difference of a mass's and an inertia's factors up to which one number scales both
TOGETHER = 0.99  # correlation over the draws from which numbers have the same cause
CHANGED = 1e-6  # relative change of a number of the model below which it is not one of the report's
FIELDS = {  # numbers of a model that effects change, with the kind of the element that has them
    **dict.fromkeys(("dof_damping", "dof_frictionloss", "dof_armature"), "joint"),
    **dict.fromkeys(("jnt_stiffness", "jnt_range", "qpos_spring"), "joint"),
    **dict.fromkeys(("body_mass", "body_inertia", "body_ipos", "body_pos"), "body"),
    **dict.fromkeys(("geom_friction", "geom_size", "geom_pos", "geom_solref"), "geom"),
    **dict.fromkeys(("actuator_gainprm", "actuator_biasprm", "actuator_dynprm"), "actuator"),
}
_MJLAB = {"dof_damping": "joint_damping", "dof_frictionloss": "joint_friction", "dof_armature": "joint_armature"}
_ISAAC = {"dof_frictionloss": "friction_distribution_params", "dof_armature": "armature_distribution_params"}


@dataclass(frozen=True)
class FieldRange:
    """The range of one number of a MuJoCo model, as ``model.<field>[index]``.

    Args:
        field: the field of ``mujoco.MjModel``.
        index: the place in it.
        element: name of the joint, body, geom or actuator.
        nominal: the number without the report's effects.
        mended: the number with them.
        low: lower end of the 95 % range, in the model's units.
        high: upper end.
        group: number of the cause; numbers of one cause, such as the mass and the inertia of a body, change together.
        falls: whether the number falls where the first one of its group rises.
    """

    field: str
    index: tuple[int, ...]
    element: str
    nominal: float
    mended: float
    low: float
    high: float
    group: int = 0
    falls: bool = False

    @property
    def ends(self) -> tuple[float, float]:
        """The ends of the range in the direction in which the first number of the group rises."""
        return (self.high, self.low) if self.falls else (self.low, self.high)


@dataclass(frozen=True)
class EffectRange:
    """The range of one parameter of an effect that is no number of an element of the model, such as a delay.

    Args:
        effect: the effect in words.
        kind: its class.
        parameter: the parameter.
        value: its fitted value.
        low: lower end of its 95 % interval.
        high: upper end.
    """

    effect: str
    kind: str
    parameter: str
    value: float
    low: float
    high: float


def model_ranges(report: ReportContents, simulation: Simulation) -> list[FieldRange]:
    """The ranges of all numbers of a model that a report's effects change, over draws of :meth:`Report.sample`.

    Args:
        report: the report.
        simulation: the simulation without its effects.
    """
    nominal, mended = (_fields(simulation, effects) for effects in ((), report.effects))
    draws = [_fields(simulation, effects) for effects in sample(report, DRAWS)]
    found: list[FieldRange] = []
    causes: list[np.ndarray] = []
    for field, kind in FIELDS.items():
        drawn = np.stack([draw[field] for draw in draws])
        size = np.maximum(np.abs(drawn).max(0), np.abs(nominal[field]))
        changed = np.abs(drawn - nominal[field]).max(0) > CHANGED * size
        low, high = np.quantile(drawn, LEVELS, axis=0)
        for index in zip(*np.nonzero(changed), strict=True):
            place = tuple(map(int, index))
            name = _name(simulation.model, field, kind, place[0])
            without, with_effects, least, most = (
                float(each[index]) for each in (nominal[field], mended[field], low, high)
            )
            group, falls = _group(drawn[(slice(None), *index)], causes)
            found.append(FieldRange(field, place, name, without, with_effects, least, most, group, falls))
    return found


def _group(drawn: np.ndarray, causes: list[np.ndarray]) -> tuple[int, bool]:
    """The cause with which a number, (draws,), changes, and whether it falls with it; a new one is added."""
    changes = drawn - drawn.mean()
    size = float(np.sqrt((changes**2).sum()))
    changes = changes / size if size > CHANGED * float(np.abs(drawn).max()) else np.zeros(len(drawn))
    for number, cause in enumerate(causes):
        if abs(likeness := float(changes @ cause)) > TOGETHER:
            return number, likeness < 0.0
    causes.append(changes)
    return len(causes) - 1, False


def effect_ranges(report: ReportContents, simulation: Simulation) -> list[EffectRange]:
    """The intervals of the parameters of other effects: on actions and observations, forces, gravity and timestep."""
    found = []
    for fitted in explanations_of(report):
        for effect, intervals in fitted:
            if isinstance(effect, ModelEffect) and not isinstance(effect, Gravity | GravityTilt | Timestep):
                continue
            words = effect_words(effect, simulation.names)
            for name, parameter in effect.parameters.items():
                ends = intervals.get(name, (parameter.value, parameter.value))
                one = EffectRange(words, type(effect).__name__, name, parameter.value, *map(float, ends))
                found += [] if one in found else [one]
    return found


def export(report: ReportContents, simulation: Simulation, folder: str | Path) -> list[Path]:
    """Writes the ranges as JSON, as code for MuJoCo Playground, mjlab and Isaac Lab, and as a table of the joints.

    Args:
        report: the report.
        simulation: the simulation without the report's effects.
        folder: created if it does not exist.

    Returns:
        The files: ``ranges.json``, ``playground.py`` (``domain_randomize`` for ``randomization_fn``), ``mjlab.py`` and
        ``isaaclab.py`` (``events``), and ``joints.csv``, a row for each hinge and slide, in SI
        units. Inertias are along the axes that the bodies have without effects; products of inertia are left out.
    """
    fields, outside = model_ranges(report, simulation), effect_ranges(report, simulation)
    singles = _of_single_joints(fields, simulation)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    texts = {
        "ranges.json": _json(fields, outside),
        "playground.py": _playground(fields, outside),
        "mjlab.py": _mjlab(singles, outside),
        "isaaclab.py": _isaaclab(singles, outside),
        "joints.csv": _joints(report, simulation, fields),
    }
    for name, text in texts.items():
        write_text(folder / name, text)
    return [folder / name for name in texts]


def _fields(simulation: Simulation, effects: Sequence[Effect]) -> dict[str, np.ndarray]:
    """Numbers of the model with effects; inertias along the principal axes that the bodies have without effects."""
    plain, model = simulation.model, simulation.with_effects(*effects).model
    found = {field: np.array(getattr(model, field), float) for field in FIELDS}
    for body in range(model.nbody):
        turned = (_axes(plain.body_iquat[body]).T @ _axes(model.body_iquat[body])) ** 2
        found["body_inertia"][body] = turned @ model.body_inertia[body]
    return found


def _axes(quaternion: np.ndarray) -> np.ndarray:
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def _name(model: mujoco.MjModel, field: str, kind: str, index: int) -> str:
    if field.startswith("dof_"):
        index = int(model.dof_jntid[index])
    elif field == "qpos_spring":
        index = int(np.searchsorted(model.jnt_qposadr, index, side="right")) - 1
    return getattr(model, kind)(index).name or f"{kind} {index}"


def _json(fields: Sequence[FieldRange], outside: Sequence[EffectRange]) -> str:
    entries = {
        "model": [asdict(one) for one in fields],
        "outside_the_model": [asdict(one) for one in outside],
    }
    return json.dumps(entries, indent=1, ensure_ascii=False) + "\n"


def _of(fields: Sequence[FieldRange], names: Mapping[str, str]) -> Iterator[tuple[str, dict[str, tuple[float, float]]]]:
    """The ranges by element of each field that another project has under a name of its own."""
    for field, name in names.items():
        ranges = {one.element: (one.low, one.high) for one in fields if one.field == field}
        if ranges:
            yield name, ranges


def _masses(fields: Sequence[FieldRange]) -> dict[str, FieldRange]:
    """The masses by body whose inertias have the same factor, so that one number scales both."""
    inertias: dict[str, list[FieldRange]] = {}
    for one in fields:
        if one.field == "body_inertia":
            inertias.setdefault(one.element, []).append(one)
    return {
        one.element: one
        for one in fields
        if one.field == "body_mass" and one.nominal > 0.0 and _scale_alike(one, inertias.get(one.element, []))
    }


def _scale_alike(mass: FieldRange, inertias: Sequence[FieldRange]) -> bool:
    factors = np.array([[one.low / one.nominal, one.high / one.nominal] for one in inertias if one.nominal > 0.0])
    own = np.array([mass.low, mass.high]) / mass.nominal
    return len(factors) > 0 and bool((np.abs(factors / own - 1.0) < ALIKE).all())


def _of_single_joints(fields: Sequence[FieldRange], simulation: Simulation) -> list[FieldRange]:
    """The numbers but those of the degrees of freedom of free and ball joints, which have no joint of their own."""
    singles = _single_joints(simulation.model)
    return [one for one in fields if not one.field.startswith("dof_") or one.element in singles]


def _single_joints(model: mujoco.MjModel) -> dict[str, int]:
    """The degree of freedom of each hinge and slide, by its name."""
    kinds = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    return {
        model.joint(i).name or f"joint {i}": int(model.jnt_dofadr[i])
        for i in range(model.njnt)
        if mujoco.mjtJoint(model.jnt_type[i]) in kinds
    }


def _rest(
    fields: Sequence[FieldRange], outside: Sequence[EffectRange], written: Collection[str], masses: Collection[str]
) -> str:
    """Comments with what a file does not hold.

    Args:
        fields: the numbers of the model.
        outside: the other effects.
        written: the fields that the file holds.
        masses: bodies whose masses and inertias it holds.
    """
    lines = []
    left = [one for one in fields if one.field not in written]
    left = [one for one in left if not (one.field in ("body_mass", "body_inertia") and one.element in masses)]
    for field in dict.fromkeys(one.field for one in left):
        names = ", ".join(dict.fromkeys(one.element for one in left if one.field == field))
        lines.append(f"# not here: {field} of {names} (see ranges.json)")
    lines += [f"# not here: {one.effect} ({one.parameter} {one.low:.6g} to {one.high:.6g})" for one in outside]
    return "".join(f"{line}\n" for line in lines)


def _playground(fields: Sequence[FieldRange], outside: Sequence[EffectRange]) -> str:
    tables = []
    for field in dict.fromkeys(one.field for one in fields):
        rows = [one for one in fields if one.field == field]
        inner = "".join(
            f"        {one.index}: ({one.group}, {one.ends[0]:.9g}, {one.ends[1]:.9g}),  # {one.element}\n"
            for one in rows
        )
        tables.append(f'    "{field}": {{\n{inner}    }},\n')
    rest = _rest(fields, outside, FIELDS, ())
    return f'''"""Domain randomisation for MuJoCo Playground: give domain_randomize to training as randomization_fn."""

import jax
import jax.numpy as jp

{rest}# by field and index: the cause, and the ends of the range; numbers of one cause change together
RANGES = {{
{"".join(tables)}}}
CAUSES = {1 + max((one.group for one in fields), default=-1)}


def domain_randomize(model, rng):
    """Returns a model with numbers drawn for each key of rng, and the axes along which they are."""

    @jax.vmap
    def drawn(key):
        shares, values = jax.random.uniform(key, (CAUSES,)), {{}}
        for field, ranges in RANGES.items():
            cause, begin, end = jp.array(list(ranges.values())).T
            places = tuple(jp.array(list(ranges)).T)
            numbers = begin + shares[cause.astype(int)] * (end - begin)
            values[field] = getattr(model, field).at[places].set(numbers)
        return values

    values = drawn(rng)
    axes = jax.tree_util.tree_map(lambda _: None, model).tree_replace(dict.fromkeys(values, 0))
    return model.tree_replace(values), axes
'''


def _mjlab(fields: Sequence[FieldRange], outside: Sequence[EffectRange]) -> str:
    terms = []
    for field, name in _MJLAB.items():
        alike: dict[tuple[int, str], list[FieldRange]] = {}
        for one in fields:
            if one.field == field:
                alike.setdefault((one.group, f"({one.low:.9g}, {one.high:.9g})"), []).append(one)
        for number, ((_, ends), ranges) in enumerate(alike.items()):
            joints = "".join(f'"{one.element}", ' for one in ranges)
            terms.append(
                f'    "{name}_{number}": EventTermCfg(\n        mode="startup",\n        func=dr.{name},\n'
                f'        params={{\n            "asset_cfg": SceneEntityCfg("robot", joint_names=({joints})),\n'
                f'            "operation": "abs",\n            "ranges": {ends},\n'
                f'            "shared_random": True,\n        }},\n    ),\n'
            )
    for body, one in _masses(fields).items():
        low, high = (0.5 * math.log(max(end, 1e-9) / one.nominal) for end in (one.low, one.high))
        terms.append(
            f'    "mass_of_{body}": EventTermCfg(  # {one.low:.6g} to {one.high:.6g} kg, with its inertia\n'
            f'        mode="startup",\n        func=dr.pseudo_inertia,\n        params={{\n'
            f'            "asset_cfg": SceneEntityCfg("robot", body_names=("{body}",)),\n'
            f'            "alpha_range": ({low:.9g}, {high:.9g}),\n        }},\n    ),\n'
        )
    return f'''"""Domain randomisation for mjlab: put these terms into the events of an environment's configuration."""

from mjlab.envs.mdp import dr
from mjlab.managers.event_manager import EventTermCfg
from mjlab.managers.scene_entity_config import SceneEntityCfg

{_rest(fields, outside, _MJLAB, _masses(fields))}events = {{
{"".join(terms)}}}
'''


def _isaaclab(fields: Sequence[FieldRange], outside: Sequence[EffectRange]) -> str:
    terms = []

    def term(name: str, function: str, chosen: str, entries: str) -> None:
        terms.append(
            f'    "{name}": EventTermCfg(\n        mode="startup",\n        func=mdp.{function},\n        params={{\n'
            f'            "asset_cfg": SceneEntityCfg("robot", {chosen}),\n{entries}'
            f'            "operation": "abs",\n        }},\n    ),\n'
        )

    for name, ranges in _of(fields, _ISAAC):
        for joint, (low, high) in ranges.items():
            entries = f'            "{name}": ({low:.9g}, {high:.9g}),\n'
            term(f"{name.split('_')[0]}_of_{joint}", "randomize_joint_parameters", f'joint_names="{joint}"', entries)
    for _, ranges in _of(fields, {"dof_damping": "damping"}):
        for joint, (low, high) in ranges.items():
            entries = f'            "damping_distribution_params": ({low:.9g}, {high:.9g}),\n'
            term(f"damping_of_{joint}", "randomize_actuator_gains", f'joint_names="{joint}"', entries)
    for body, one in _masses(fields).items():
        entries = f'            "mass_distribution_params": ({one.low:.9g}, {one.high:.9g}),\n'
        term(f"mass_of_{body}", "randomize_rigid_body_mass", f'body_names="{body}"', entries)
    return f'''"""Domain randomisation for Isaac Lab: put these terms into the events of an environment's configuration.

The friction of a joint is a torque in N·m, as Isaac Sim 5 takes it; earlier versions take a coefficient. The damping is
that of a joint without its servo's: add the servo's to it.
"""

import isaaclab.envs.mdp as mdp
from isaaclab.managers import EventTermCfg, SceneEntityCfg

{_rest(fields, outside, (*_ISAAC, "dof_damping"), _masses(fields))}events = {{
{"".join(terms)}}}
'''


def _joints(report: ReportContents, simulation: Simulation, fields: Sequence[FieldRange]) -> str:
    """A row for each hinge and slide: armature, damping and friction with their ranges, and the delay of its motor."""
    model, by_place = simulation.model, {(one.field, one.index[0]): one for one in fields}
    columns = {"dof_armature": "armature", "dof_damping": "damping", "dof_frictionloss": "friction"}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["joint", *(f"{name}{end}" for name in columns.values() for end in ("", " low", " high")), "delay"])
    for joint, dof in _single_joints(model).items():
        cells = []
        for field in columns:
            own, nominal = by_place.get((field, dof)), float(getattr(model, field)[dof])
            values = (nominal,) * 3 if own is None else (own.mended, own.low, own.high)
            cells += [f"{value:.6g}" for value in values]
        driven = [i for i in range(model.nu) if model.actuator_trnid[i, 0] == model.dof_jntid[dof]]
        delays = [one for one in report.effects if isinstance(one, ActionDelay)]
        delay = sum(one.delay for one in delays if driven and (one.actuators is None or driven[0] in one.actuators))
        writer.writerow([joint, *cells, f"{delay:.6g}"])
    return text.getvalue()
