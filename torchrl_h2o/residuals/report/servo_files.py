"""A report's values for the joints that motors drive, in the formats of BAM and PACE."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence

import mujoco
import numpy as np
import torch

from torchrl_h2o.effects import (
    ActionDelay,
    Effect,
    LoadFriction,
    ObservationBias,
    ObservationDelay,
    StribeckFriction,
    selection,
)
from torchrl_h2o.effects.catalogue.mechanism import Mechanism
from torchrl_h2o.residuals.report.contents import ReportContents
from torchrl_h2o.residuals.simulation.simulation import Simulation


def driven_joints(model: mujoco.MjModel) -> dict[str, tuple[int, tuple[int, ...]]]:
    """The degree of freedom and the actuators of each hinge and slide that actuators drive, by the joint's name."""
    mechanism = Mechanism(model)
    driven = [mechanism.joint_of(actuator) for actuator in range(model.nu)]
    return {
        model.joint(joint).name or f"joint {joint}": (
            int(model.jnt_dofadr[joint]),
            tuple(actuator for actuator, own in enumerate(driven) if own == joint),
        )
        for joint in mechanism.single_joints
        if joint in driven
    }


def delay_of(effects: Sequence[Effect], actuators: Sequence[int]) -> float:
    """Time in s by which a report's effects delay actuators, which all sensors together may do instead."""
    late = [one.delay for one in effects if isinstance(one, ObservationDelay) and one.entries is None]
    motors = [one for one in effects if isinstance(one, ActionDelay)]
    return sum(late) + sum(one.delay for one in motors if one.actuators is None or set(actuators) & set(one.actuators))


def bam_files(report: ReportContents, simulation: Simulation) -> dict[str, str]:
    """Parameters of BAM's friction model as JSON, by the name of the driven joint.

    The model is the simplest of M1 to M6 that holds the effects. BAM's loader also needs the name of the servo
    (``actuator``), which is left empty, and takes its own ``kt`` and ``R``, which positions do not tell.

    Source: github.com/Rhoban/bam, ``bam/model.py``; see :class:`~torchrl_h2o.effects.LoadFriction` for the paper.

    Args:
        report: the report.
        simulation: the simulation without the report's effects.
    """
    model = simulation.with_effects(*report.effects).model
    return {
        name: json.dumps(_bam(report.effects, model, dof), indent=1) + "\n"
        for name, (dof, _) in driven_joints(model).items()
    }


def _bam(effects: Sequence[Effect], model: mujoco.MjModel, dof: int) -> dict[str, float | str]:
    gears = [one for one in effects if isinstance(one, LoadFriction | StribeckFriction)]
    gears = [one for one in gears if dof in selection.joint_dofs(model, one.joints)]
    load = [one for one in gears if isinstance(one, LoadFriction)]
    rest = [one for one in gears if isinstance(one, StribeckFriction)]
    values: dict[str, float | str] = {
        "actuator": "",
        "armature": float(model.dof_armature[dof]),
        "friction_base": float(model.dof_frictionloss[dof]),
        "friction_viscous": float(model.dof_damping[dof]),
    }
    squares = {
        f"load_friction_{of}_quad": sum(getattr(one, name) for one in rest)
        for of, name in (("motor", "motor_square"), ("external", "weight_square"))
    }
    has_squares = any(squares.values())
    directional = has_squares or any(one.weight != 1.0 for one in gears)
    has_load = has_squares or bool(load) or any(one.share for one in rest)
    if has_load:
        values |= _shares("load_friction", load, directional)
    if rest:
        values |= {
            "friction_stribeck": sum(one.torque for one in rest),
            "dtheta_stribeck": rest[0].speed,
            "alpha": rest[0].exponent,
        }
        if has_load:
            values |= _shares("load_friction", rest, directional, "_stribeck")
    names = {(False, False): "m1", (True, False): "m2", (False, True): "m3", (True, True): "m4"}
    # M5 and M6 alone tell motor and weight apart, and have all other terms
    values["model"] = "m6" if has_squares else "m5" if directional else names[bool(rest), has_load]
    if directional:
        zeros = ("friction_stribeck", *(f"load_friction_{of}_stribeck" for of in ("motor", "external")))
        values = dict.fromkeys(zeros, 0.0) | {"dtheta_stribeck": 1.0, "alpha": 1.0} | values
    return values | squares if has_squares else values


def _shares(
    name: str, effects: Sequence[LoadFriction | StribeckFriction], directional: bool, end: str = ""
) -> dict[str, float]:
    share, of_weight = sum(one.share for one in effects), sum(one.share * one.weight for one in effects)
    if directional:
        return {f"{name}_motor{end}": share, f"{name}_external{end}": of_weight}
    return {f"{name}{end or '_base'}": share}


def pace_files(report: ReportContents, simulation: Simulation) -> dict[str, bytes]:
    """Values of the driven joints as PACE's fit saves them: ``mean_000.pt`` and ``config.pt``.

    The mean is a tensor of the joints' armatures, dampings, frictions and encoder biases, and of one delay in physics
    steps, (4 n + 1); the configuration names the joints in this order.

    Source: github.com/leggedrobotics/pace-sim2real, ``optim/cma_es.py``.

    Args:
        report: the report.
        simulation: the simulation without the report's effects.
    """
    model, observed = simulation.with_effects(*report.effects).model, list(simulation.state_map.names)
    joints = driven_joints(model)
    dofs = [dof for dof, _ in joints.values()]
    biases = np.zeros(len(observed))
    for effect in report.effects:
        if isinstance(effect, ObservationBias):
            biases[slice(None) if effect.entries is None else list(effect.entries)] += effect.bias
    bias = [biases[observed.index(name)] if name in observed else 0.0 for name in joints]
    delay = max((delay_of(report.effects, own) for _, own in joints.values()), default=0.0)
    values = [
        *model.dof_armature[dofs],
        *model.dof_damping[dofs],
        *model.dof_frictionloss[dofs],
        *bias,
        round(delay / model.opt.timestep),
    ]
    return {
        "mean_000.pt": _saved(torch.tensor(values, dtype=torch.float32)),
        "config.pt": _saved({"joint_order": list(joints)}),
    }


def _saved(value: object) -> bytes:
    file = io.BytesIO()
    torch.save(value, file)
    return file.getvalue()
