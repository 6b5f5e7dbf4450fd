"""Writes what a report leaves open for domain randomisation in other projects."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jinja2
import mujoco
import numpy as np

from torchrl_h2o.effects.catalogue.mechanism import Mechanism
from torchrl_h2o.residuals.report.contents import ReportContents
from torchrl_h2o.residuals.report.ranges import EffectRange, FieldRange, effect_ranges, model_ranges
from torchrl_h2o.residuals.report.servo_files import bam_files, delay_of, driven_joints, pace_files
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.whole_file import whole_file

ALIKE = 0.02  # relative difference of a mass's and an inertia's factors up to which one number scales both
#: function and argument of each field in the two projects whose events have one shape
MJLAB = {
    "dof_damping": ("joint_damping", "ranges"),
    "dof_frictionloss": ("joint_friction", "ranges"),
    "dof_armature": ("joint_armature", "ranges"),
}
ISAACLAB = {
    "dof_damping": ("randomize_actuator_gains", "damping_distribution_params"),
    "dof_frictionloss": ("randomize_joint_parameters", "friction_distribution_params"),
    "dof_armature": ("randomize_joint_parameters", "armature_distribution_params"),
}
_TEMPLATES = jinja2.Environment(
    loader=jinja2.PackageLoader("torchrl_h2o.residuals.report", "."),
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)


def export(report: ReportContents, simulation: Simulation, folder: str | Path) -> list[Path]:
    """Writes ranges as JSON and as code for MuJoCo Playground, mjlab and Isaac Lab, and values for BAM and PACE.

    Args:
        report: the report.
        simulation: the simulation without the report's effects.
        folder: created if it does not exist.

    Returns:
        The files: ``ranges.json``, ``playground.py`` (``domain_randomize`` for ``randomization_fn``), ``mjlab.py`` and
        ``isaaclab.py`` (``events``), ``joints.csv``, a row for each hinge and slide, in SI units, ``bam``, a file for
        each driven joint, and ``pace``.
    """
    fields, outside = model_ranges(report, simulation), effect_ranges(report, simulation)
    ranges = {"model": [asdict(one) for one in fields], "outside_the_model": [asdict(one) for one in outside]}
    masses, joints = _masses(fields), _joints(simulation.model)
    events = [one for one in fields if one.field in MJLAB and one.element in joints]
    events += [one for one in fields if one.field in ("body_mass", "body_inertia") and one.element in masses]
    rest = _rest([one for one in fields if one not in events], outside)
    together = {"operation": '"abs"', "shared_random": "True"}
    alphas = {
        body: tuple(0.5 * math.log(max(end, 1e-9) / one.nominal) for end in (one.low, one.high))
        for body, one in masses.items()
    }
    scaled = [
        _term(f"mass_of_{body}", "pseudo_inertia", [body], {"alpha_range": _pair(alphas[body])}) for body in masses
    ]
    weighed = [
        _term(
            f"mass_of_{body}",
            "randomize_rigid_body_mass",
            [body],
            {"mass_distribution_params": _pair((one.low, one.high)), "operation": '"abs"'},
        )
        for body, one in masses.items()
    ]
    texts = {
        "ranges.json": json.dumps(ranges, indent=1, ensure_ascii=False) + "\n",
        "playground.py": _filled("playground.py", fields=fields, rest=_rest([], outside)),
        "mjlab.py": _filled("mjlab.py", terms=_of_joints(events, MJLAB, together) + scaled, rest=rest),
        "isaaclab.py": _filled(
            "isaaclab.py", terms=_of_joints(events, ISAACLAB, {"operation": '"abs"'}) + weighed, rest=rest
        ),
        "joints.csv": _table(report, simulation, fields),
    }
    folder = Path(folder)
    texts |= {f"bam/{joint.replace('/', '_')}.json": text for joint, text in bam_files(report, simulation).items()}
    tensors = {f"pace/{name}": saved for name, saved in pace_files(report, simulation).items()}
    for name, content in {**texts, **tensors}.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as partial:
            partial.write_bytes(content.encode() if isinstance(content, str) else content)
    return [folder / name for name in (*texts, *tensors)]


def _filled(name: str, **values: Any) -> str:
    return _TEMPLATES.get_template(f"{name}.jinja").render(**values)


def _term(name: str, function: str, elements: Sequence[str], entries: Mapping[str, str]) -> dict[str, Any]:
    """One event: its name, its function, the joints or bodies, and the arguments as code."""
    chosen = "body_names" if name.startswith("mass_of") else "joint_names"
    return {"name": name, "function": function, "chosen": chosen, "elements": elements, "entries": entries}


def _pair(ends: Sequence[float]) -> str:
    return f"({ends[0]:.9g}, {ends[1]:.9g})"


def _of_joints(
    fields: Sequence[FieldRange], names: Mapping[str, tuple[str, str]], others: Mapping[str, str]
) -> list[dict[str, Any]]:
    """A term for each field and for the joints whose numbers have one cause and one range."""
    alike: dict[tuple[str, int, str], list[str]] = {}
    for one in fields:
        if one.field in names:
            alike.setdefault((one.field, one.group, _pair((one.low, one.high))), []).append(one.element)
    return [
        _term(f"{field.removeprefix('dof_')}_{number}", names[field][0], joints, {names[field][1]: ends, **others})
        for number, ((field, _, ends), joints) in enumerate(alike.items())
    ]


def _masses(fields: Sequence[FieldRange]) -> dict[str, FieldRange]:
    """The masses by body whose inertias have the same factor, so that one number scales both."""
    found = {}
    for mass in fields:
        inertias = [one for one in fields if one.field == "body_inertia" and one.element == mass.element]
        if mass.field == "body_mass" and inertias and min(mass.nominal, *(one.nominal for one in inertias)) > 0.0:
            factors = np.array([[one.low / one.nominal, one.high / one.nominal] for one in (mass, *inertias)])
            if (np.abs(factors / factors[0] - 1.0) < ALIKE).all():
                found[mass.element] = mass
    return found


def _joints(model: mujoco.MjModel) -> dict[str, int]:
    """The degree of freedom of each hinge and slide, by its name."""
    return {model.joint(i).name or f"joint {i}": int(model.jnt_dofadr[i]) for i in Mechanism(model).single_joints}


def _rest(fields: Sequence[FieldRange], outside: Sequence[EffectRange]) -> list[str]:
    """What a file does not hold, in words."""
    elements: dict[str, dict[str, None]] = {}
    for one in fields:
        elements.setdefault(one.field, {})[one.element] = None
    lines = [f"{field} of {', '.join(names)} (see ranges.json)" for field, names in elements.items()]
    return lines + [f"{one.effect} ({one.parameter} {one.low:.6g} to {one.high:.6g})" for one in outside]


def _table(report: ReportContents, simulation: Simulation, fields: Sequence[FieldRange]) -> str:
    """A row for each hinge and slide: armature, damping and friction with their ranges, and the delay of its motor."""
    model, by_place = simulation.model, {(one.field, one.index[0]): one for one in fields}
    columns = {"dof_armature": "armature", "dof_damping": "damping", "dof_frictionloss": "friction"}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["joint", *(f"{name}{end}" for name in columns.values() for end in ("", " low", " high")), "delay"])
    for joint, dof in _joints(model).items():
        cells = []
        for field in columns:
            own, nominal = by_place.get((field, dof)), float(getattr(model, field)[dof])
            values = (nominal,) * 3 if own is None else (own.mended, own.low, own.high)
            cells += [f"{value:.6g}" for value in values]
        _, driven = driven_joints(model).get(joint, (dof, ()))
        writer.writerow([joint, *cells, f"{delay_of(report.effects, driven) if driven else 0.0:.6g}"])
    return text.getvalue()
