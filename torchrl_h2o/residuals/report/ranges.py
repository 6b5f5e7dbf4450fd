"""What a report leaves open, as ranges of the numbers of a MuJoCo model and of the effects outside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from torchrl_h2o.effects import Effect
from torchrl_h2o.residuals.report.contents import ReportContents
from torchrl_h2o.residuals.report.sampling import explanations_of, sample
from torchrl_h2o.residuals.report.words import effect_words
from torchrl_h2o.residuals.simulation.simulation import Simulation

DRAWS = 400  # of Report.sample, from which ranges are taken
LEVELS = (0.025, 0.975)  # of the ranges' ends
TOGETHER = 0.99  # correlation over the draws from which numbers have the same cause
CHANGED = 1e-6  # relative change of a number of the model below which it is not one of the report's
FIELDS = {  # numbers of a model that effects change, with the kind of the element that has them
    **dict.fromkeys(("dof_damping", "dof_frictionloss", "dof_armature"), "joint"),
    **dict.fromkeys(("jnt_stiffness", "jnt_range", "qpos_spring"), "joint"),
    **dict.fromkeys(("body_mass", "body_inertia", "body_ipos", "body_pos"), "body"),
    **dict.fromkeys(("geom_friction", "geom_size", "geom_pos", "geom_solref"), "geom"),
    **dict.fromkeys(("actuator_gainprm", "actuator_biasprm", "actuator_dynprm"), "actuator"),
}


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
    group: int
    falls: bool

    @property
    def ends(self) -> tuple[float, float]:
        """The ends of the range in the direction in which the first number of the group rises."""
        return (self.high, self.low) if self.falls else (self.low, self.high)


@dataclass(frozen=True)
class EffectRange:
    """The range of one parameter of an effect that changes none of these numbers, such as a delay or gravity.

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

    Inertias are along the principal axes that the bodies have without effects; products of inertia are left out.

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
        low, high = np.quantile(drawn, LEVELS, axis=0)
        for index in zip(*np.nonzero(_changed(drawn, nominal[field])), strict=True):
            place = tuple(map(int, index))
            name = _name(simulation.model, field, kind, place[0])
            plain, with_effects, least, most = (float(one[index]) for one in (nominal[field], mended[field], low, high))
            cause = _cause(drawn[(slice(None), *index)], causes)
            found.append(FieldRange(field, place, name, plain, with_effects, least, most, *cause))
    return found


def effect_ranges(report: ReportContents, simulation: Simulation) -> list[EffectRange]:
    """The intervals of the parameters of the effects that change none of the numbers of :func:`model_ranges`."""
    found, nominal = [], _fields(simulation, ())
    for effect, intervals in (pair for fitted in explanations_of(report) for pair in fitted):
        changed = _fields(simulation, (effect,))
        if any(_changed(changed[field][None], nominal[field]).any() for field in FIELDS):
            continue
        words = effect_words(effect, simulation.names)
        for name, parameter in effect.parameters.items():
            low, high = intervals.get(name, (parameter.value, parameter.value))
            found.append(EffectRange(words, type(effect).__name__, name, parameter.value, float(low), float(high)))
    return list(dict.fromkeys(found))


def _changed(drawn: np.ndarray, nominal: np.ndarray) -> np.ndarray:
    """Which numbers of draws, (draws, ...), differ from the nominal ones."""
    size = np.maximum(np.abs(drawn).max(0), np.abs(nominal))
    return np.abs(drawn - nominal).max(0) > CHANGED * size


def _cause(drawn: np.ndarray, causes: list[np.ndarray]) -> tuple[int, bool]:
    """The cause with which a number, (draws,), changes, and whether it falls with it; a new one is added."""
    changes = drawn - drawn.mean()
    size = float(np.linalg.norm(changes))
    changes = changes / size if size > CHANGED * float(np.abs(drawn).max()) else np.zeros(len(drawn))
    for number, cause in enumerate(causes):
        if abs(likeness := float(changes @ cause)) > TOGETHER:
            return number, likeness < 0.0
    causes.append(changes)
    return len(causes) - 1, False


def _fields(simulation: Simulation, effects: Sequence[Effect]) -> dict[str, np.ndarray]:
    model = simulation.with_effects(*effects).model
    found = {field: np.array(getattr(model, field), float) for field in FIELDS}
    plain, own = (Rotation.from_quat(one.body_iquat, scalar_first=True) for one in (simulation.model, model))
    turned = (plain.inv() * own).as_matrix() ** 2
    found["body_inertia"] = (turned @ model.body_inertia[:, :, None])[:, :, 0]
    return found


def _name(model: mujoco.MjModel, field: str, kind: str, index: int) -> str:
    if field.startswith("dof_"):
        index = int(model.dof_jntid[index])
    elif field == "qpos_spring":
        index = int(np.searchsorted(model.jnt_qposadr, index, side="right")) - 1
    return getattr(model, kind)(index).name or f"{kind} {index}"
