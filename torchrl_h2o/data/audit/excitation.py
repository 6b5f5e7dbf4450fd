"""Which effects a log can tell apart: angles between their sensitivities along the log."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchrl_h2o.data.audit.finding import Finding
from torchrl_h2o.data.audit.response import Response

CHECK = "excitation"
NEGLIGIBLE = 0.02  # size of a response, in usual changes of the velocities, below which it shows nothing
ALIKE = 0.9  # cosine of the angle between two effects' sensitivities from which they look alike
COMBINED = 0.92  # correlation with the other effects of a joint from which an effect looks like their combination
_JOINT = ("dry friction", "viscous friction", "armature")
_REVERSALS = "record both directions under the same torque, such as slow reversals beside fast swings, or let it swing"
_HOLDING = "record fast motion with a known torque: gravity shows at rest, mass in acceleration"
_TO_RECORD = {
    ("dry friction", "motor gain"): _REVERSALS,
    ("dry friction", "viscous friction"): "record slow and fast motion of the joint",
    ("dry friction", "armature"): "record several frequencies of motion",
    ("viscous friction", "motor gain"): "record actions that do not follow the velocity, such as random ones",
    ("viscous friction", "armature"): "record several frequencies of motion",
    ("viscous friction", "drive delay"): "record steps of the action from rest",
    ("armature", "motor gain"): "record a constant torque against gravity beside fast changes",
    ("armature", "gravity"): "record fast and slow motion through the same angles",
    ("armature", "mass"): "weigh the robot",
    ("motor gain", "drive delay"): "record steps of the action",
    ("motor gain", "gravity"): "record fast motion beside holding still",
    ("motor gain", "mass"): "only their ratio shows in the motion: weigh the robot, or measure a torque",
    ("gravity", "mass"): _HOLDING,
}  # in the order of :func:`sensitivities`


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """What a trial of one effect changes along the log.

    Args:
        effect: such as ``"dry friction"``.
        joint: name of the joint or actuator; empty for the whole robot.
        response: weighted changes of the velocities, (W · m,).
    """

    effect: str
    joint: str
    response: np.ndarray

    def __str__(self) -> str:
        return f"{self.effect} of {self.joint}" if self.joint else self.effect


def check_excitation(response: Response) -> list[Finding]:
    """Notes which of the main effects look alike in this log, with what to record to tell them apart."""
    found = sensitivities(response)
    size = [float(np.sqrt((s.response**2).mean())) for s in found]
    seen = [s for s, usual in zip(found, size, strict=True) if usual > NEGLIGIBLE]
    notes = _pairs(seen)
    return [*notes, *_combinations(seen, notes)]


def sensitivities(response: Response) -> list[Sensitivity]:
    """Changes of the velocities at the end of the windows for trials of the main effects.

    Per joint: dry friction, viscous friction and armature; per actuator: gain and delay by one row; gravity and mass of
    the whole robot.
    """
    from torchrl_h2o.effects import BodyMass, Gravity

    log, found = response.log, []
    velocity = response.before + 0.5 * response.change
    spread = np.maximum(velocity.std(0), 1e-12)
    seconds = response.horizon * log.dt

    def add(effect: str, joint: str, change: np.ndarray) -> None:
        weighted = np.clip(change / response.scale, -10.0, 10.0)
        found.append(Sensitivity(effect, joint, np.nan_to_num(weighted).ravel()))

    for index, moving in enumerate(log.velocities):
        force = response.by_force[..., index]
        add("dry friction", moving.name, -force * np.tanh(velocity[:, [index]] / (0.1 * spread[index])))
        add("viscous friction", moving.name, -force * velocity[:, [index]])
        add("armature", moving.name, -force * response.change[:, [index]] / seconds)
    actions, _ = response.mean_action(0)
    late, known = response.mean_action(1)
    for index in range(len(log.actuators)):
        label = log.moved_by(index)
        own = response.by_action[..., index]
        add("motor gain", label, own * actions[:, [index]])
        add("drive delay", label, own * np.where(known, late[:, index] - actions[:, index], 0.0)[:, None])
    logged = response.limited[response.rows]  # the simulation of ``response.simulated`` may be one without actions
    base = response.reached(response.states, logged)
    for effect, name in ((Gravity(1.1), "gravity"), (BodyMass(1.1), "mass")):
        try:
            other = response.simulation.with_effects(effect)
            reached = response.reached(response.states, logged, simulation=other)
        except ValueError:  # the model has no gravity or no such body
            continue
        add(name, "", 10.0 * (reached - base)[:, response.moving])
    return found


def _pairs(found: list[Sensitivity]) -> list[Finding]:
    notes = []
    for i, one in enumerate(found):
        for other in found[i + 1 :]:
            if one.joint != other.joint and one.joint and other.joint:
                continue
            cosine = _cosine(one.response, other.response)
            if abs(cosine) < ALIKE:
                continue
            record = _TO_RECORD.get((one.effect, other.effect), "record other motion of this joint")
            words = f"{one} and {other} look alike in this log, each weak beside the other (cosine {cosine:.2f})"
            if one.joint == other.joint != "":
                words = f"{one.effect} and {other}{words[len(f'{one} and {other}') :]}"
            notes.append(Finding(CHECK, "note", words, None, record))
    return notes


def _combinations(found: list[Sensitivity], pairs: list[Finding]) -> list[Finding]:
    """Motor gains that friction, armature and gravity together can take the place of."""
    notes = []
    for gain in (s for s in found if s.effect == "motor gain"):
        if any(
            note.words.startswith(f"{effect} and motor gain of {gain.joint} ") for note in pairs for effect in _JOINT
        ):
            continue
        # total mass and motor gain are only identifiable as a ratio, which has a note of its own
        others = [s for s in found if s.joint in (gain.joint, "") and s.effect in (*_JOINT, "gravity")]
        if not others:
            continue
        design = np.stack([s.response for s in others], -1)
        size = np.maximum(np.linalg.norm(design, axis=0), 1e-12)
        values = np.linalg.lstsq(design / size, gain.response, rcond=None)[0]
        multiple = _cosine(design / size @ values, gain.response)
        if multiple < COMBINED:
            continue
        strongest = [others[i].effect for i in np.argsort(-np.abs(values))[:3]]
        others_words = f"a combination of {', '.join(strongest)}"
        words = f"motor gain of {gain.joint} is weak in this log, because {others_words} looks like a weaker motor "
        record = "record torques that do not follow the motion, such as random ones"
        notes.append(Finding(CHECK, "note", f"{words}(correlation {multiple:.2f})", None, record))
    return notes


def _cosine(one: np.ndarray, other: np.ndarray) -> float:
    size = np.linalg.norm(one) * np.linalg.norm(other)
    return float(one @ other / size) if size > 0.0 else 0.0
