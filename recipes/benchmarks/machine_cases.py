"""Cases from simulated machines with several faults, whose velocities come from a filter or from the positions."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import mujoco
import numpy as np
from cases import Case, Family
from machines import MACHINES, Machine
from scoring import is_marked_undeclared, parameter_error, part_of
from tensordict import TensorDict

from torchrl_h2o.data import Column, LogColumns, read_robot_log
from torchrl_h2o.effects import (
    ActionDelay,
    ActionGain,
    ActionLag,
    Armature,
    BodyMass,
    Effect,
    JointDamping,
    JointForce,
    JointFrictionLoss,
    JointSpring,
    ObservationDelay,
    Payload,
    ServoStiffness,
)
from torchrl_h2o.residuals import Report, Simulation
from torchrl_h2o.residuals.report.contents import EXPLAINED_IN_PART, NOT_EXPLAINED

ARM = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")  # joints of the arm
WITHIN = 0.15  # relative error of a parameter
#: the faults of each machine that a catalogue has
TRUTH: Mapping[str, tuple[Effect, ...]] = MappingProxyType(
    {
        "cart-pole": (JointFrictionLoss(1.5, "cart"), JointDamping(0.8, "cart"), BodyMass(1.15, "pole")),
        "two links with a payload": (Payload(0.4, z=-0.3, bodies="lower"), ActionGain(0.9, (1,))),
        "two links without a fault": (),
        "links with weak servos": (ServoStiffness(0.7), JointFrictionLoss(0.2, "shoulder")),
        # the cable is slack at 0.3 rad: a spring about 0 rad, and the torque 0.8 N·m/rad × 0.3 rad
        "leg with a cable": (JointSpring(0.8, "knee"), JointForce(0.24, "knee")),
        "rotary pendulum": (Armature(4e-5, "arm"), JointDamping(5e-4, "arm"), JointDamping(5e-5, "pendulum")),
        "six-joint arm": (
            *(JointFrictionLoss(size, joint) for joint, size in zip(ARM, (6.0, 7.0, 5.0, 1.2, 1.0, 0.8), strict=True)),
            *(JointDamping(size, joint) for joint, size in zip(ARM, (4.0, 5.0, 3.0, 0.6, 0.5, 0.4), strict=True)),
            Payload(1.2, y=0.12, z=0.03, bodies="wrist_3"),
        ),
        "linear axis": (
            JointFrictionLoss(20.0, "carriage"),
            JointDamping(200.0, "carriage"),
            JointForce(-3.0, "carriage"),
        ),
    }
)
#: machines with a fault that a catalogue does not have: friction that depends on the position
NOT_IN_CATALOGUE = ("geared arm",)


@dataclass(frozen=True, kw_only=True)
class MachineCase(Case):
    """A case with the log of a machine.

    Args:
        estimated: whether the log has no velocities, so that they are estimated from the positions.
    """

    estimated: bool

    @property
    def machine(self) -> Machine:
        return MACHINES[self.system]

    @property
    def joints(self) -> list[str]:
        model = mujoco.MjModel.from_xml_path(str(self.machine.path))
        return [model.joint(index).name for index in range(model.njnt)]

    def simulation(self) -> Simulation:
        velocities = [f"{joint}_velocity" for joint in self.joints]
        return Simulation.from_mjcf(self.machine.path, [*self.joints, *velocities], self.machine.step)

    def measure(self) -> TensorDict:
        observation, commands = self.machine.record(self.seed)
        actions = [f"u{index}" for index in range(commands.shape[1])]
        velocities = [
            Column(f"{joint}_velocity", "observation", derivative_of=joint if self.estimated else None)
            for joint in self.joints
        ]
        columns = [*(Column(joint, "observation") for joint in self.joints), *velocities]
        columns += [Column(action, "action") for action in actions]
        if self.estimated:
            observation = observation[:, : len(self.joints)]
        names = [*self.joints, *(() if self.estimated else (column.name for column in velocities)), *actions]
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "log.csv"
            rows = np.hstack([observation, commands])
            np.savetxt(path, rows, delimiter=",", header=",".join(names), comments="", fmt="%.7g")
            layout = LogColumns(tuple(columns), dt=self.machine.step, separator=",", header=True)
            return read_robot_log(path, layout)


def machine(number: int, rng: np.random.Generator) -> MachineCase:
    """Each machine twice: with its velocities, and without them."""
    name = list(MACHINES)[number // 2]
    estimated = number % 2 == 1
    return MachineCase(
        name=f"{name}, velocities {'estimated' if estimated else 'filtered'}",
        system=name,
        judge=judge_unknown if name in NOT_IN_CATALOGUE else judge_machine,
        truth=TRUTH.get(name, ()),
        seed=int(rng.integers(2**31)),
        estimated=estimated,
    )


def judge_machine(report: Report, case: MachineCase) -> dict:
    """Passed if all faults are found, with values within 15 %, and besides them only lateness.

    Velocities may be late, and actuators and sensors by the machine's own delay and less than a control step more.
    """
    simulation, most = case.simulation(), case.machine.delay + case.machine.step
    error = parameter_error(report, case.truth, simulation)
    groups = {group.effects[0]: group.effects for group in report.indistinguishable}
    others = [
        effect
        for effect in report.effects
        if not _is_late(effect, most)
        and not any(part_of(e, true, simulation) for e in groups.get(effect, (effect,)) for true in case.truth)
    ]
    return {"ok": error <= WITHIN and not others, "parameter_error": error, "others": len(others)}


def judge_unknown(report: Report, case: MachineCase) -> dict:
    """Passed if the report says that something is missing, or has a force outside the catalogue."""
    kind = None if report.verdict is None else report.verdict.kind
    return {"ok": kind in (EXPLAINED_IN_PART, NOT_EXPLAINED) or is_marked_undeclared(report)}


def _is_late(effect: Effect, most: float) -> bool:
    """Whether an effect delays velocities, or actuators or all sensors by less than ``most`` seconds."""
    if isinstance(effect, ActionLag):
        return effect.time_constant < most
    if isinstance(effect, ObservationDelay) and effect.entries is not None:
        return True
    return isinstance(effect, ActionDelay | ObservationDelay) and effect.delay < most


MACHINE = Family(
    machine, 2 * len(MACHINES), 2 * len(MACHINES), "faults of machines with encoders, within 15 %", stream=9
)
