"""What a compiled model is built like, as far as a catalogue of effects has to know.

Which joints carry a floating root, what moves in one plane, what can touch, and how large torques are.
"""

import mujoco
import numpy as np

from torchrl_h2o.effects.settings import EFFECT_SETTINGS, EffectSettings

# as integers: MuJoCo's own constants are not found in tuples by the integers that a model holds
_FREE, _HINGE, _SLIDE = (int(getattr(mujoco.mjtJoint, f"mjJNT_{kind}")) for kind in ("FREE", "HINGE", "SLIDE"))
_JOINT_TRANSMISSIONS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_ROUND = tuple(int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}")) for kind in ("SPHERE", "CYLINDER", "ELLIPSOID"))


class Mechanism:
    """Facts about a model at its initial position.

    Args:
        model: the compiled model.
        settings: the lever arm for torques without an actuator, and the scales of the trials.
    """

    def __init__(self, model: mujoco.MjModel, settings: EffectSettings = EFFECT_SETTINGS):
        self.model = model
        self.settings = settings
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        self._axes = data.xaxis.copy()
        self.single_joints = [j for j in range(model.njnt) if model.jnt_type[j] in (_HINGE, _SLIDE)]
        self.mass = float(model.body_mass.sum())
        self.weight = self.mass * float(np.linalg.norm(model.opt.gravity))

    def driven(self, joint: int) -> bool:
        """Whether an actuator acts on a joint by itself."""
        return joint in self._joint_of_actuators()

    def actuator_label(self, actuator: int) -> str:
        """The name of an actuator, or of the joint that it drives."""
        name, joint = self.model.actuator(actuator).name, self._joint_of_actuators()[actuator]
        return name or (self.model.joint(joint).name if joint is not None else "")

    def floating(self, joint: int) -> bool:
        """Whether a joint lets the whole mechanism float: no bearing, in which nothing rubs or springs.

        Such are a free joint, and undriven joints, at least two and one of them sliding, between the
        world and one body.
        """
        model, body = self.model, self.model.jnt_bodyid[joint]
        if model.jnt_type[joint] == _FREE:
            return True
        mates = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
        if model.body_parentid[body] != 0 or len(mates) < 2 or any(self.driven(mate) for mate in mates):
            return False
        return any(self.slides(mate) for mate in mates)

    def planar(self, body: int) -> bool:
        """Whether a body can move in the x-z plane alone: slides in it, hinges about y."""
        while body:
            first = self.model.body_jntadr[body]
            for joint in range(first, first + self.model.body_jntnum[body]):
                along_y = abs(self._axes[joint][1])
                aligned = self.settings.aligned
                kind = self.model.jnt_type[joint]
                if not ((kind == _HINGE and along_y > 1.0 - aligned) or (kind == _SLIDE and along_y < aligned)):
                    return False
            body = self.model.body_parentid[body]
        return True

    def axes(self, body: int) -> tuple[str, ...]:
        """The axes of a body's frame along which it matters where its mass lies."""
        return ("x", "z") if self.planar(body) else ("x", "z", "y")

    def slides(self, joint: int) -> bool:
        """Whether a joint is a sliding one."""
        return self.model.jnt_type[joint] == _SLIDE

    def wheel(self, geom: int) -> bool:
        """Whether a geom can roll: round, on a body that turns without a limit against another."""
        model, body = self.model, self.model.geom_bodyid[geom]
        joints = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
        turning = any(model.jnt_type[j] == _HINGE and not model.jnt_limited[j] for j in joints)
        return turning and model.geom_type[geom] in _ROUND and not any(self.floating(j) for j in joints)

    def torque(self, joint: int) -> float:
        """The largest torque (force) on a joint: its actuator's, else the weight (times 0.1 m)."""
        largest = 0.0
        for actuator, target in enumerate(self._joint_of_actuators()):
            if target == joint:
                largest += abs(self.model.actuator_gear[actuator, 0]) * self.control(actuator)
        lever = self.settings.lever if self.model.jnt_type[joint] == _HINGE else 1.0
        return largest or self.weight * lever or 1.0

    def control(self, actuator: int) -> float:
        """The largest control of an actuator, 1 if it has no limit."""
        if not self.model.actuator_ctrllimited[actuator]:
            return 1.0
        return float(np.abs(self.model.actuator_ctrlrange[actuator]).max())

    def inertia(self, joint: int) -> float:
        """The inertia of the whole mechanism that a joint feels, in kg·m² (kg)."""
        return float(self.model.dof_M0[self.model.jnt_dofadr[joint]])

    def radius_of_gyration(self, body: int) -> float:
        """The square root of a body's largest inertia over its mass, in m."""
        return float(np.sqrt(self.model.body_inertia[body].max() / self.model.body_mass[body]))

    def touching(self) -> list[tuple[int, int]]:
        """The pairs of geoms that may collide by their masks, on bodies that move against each other."""
        model, pairs = self.model, []
        weld, parent = model.body_weldid, model.body_parentid
        for a in range(model.ngeom):
            for b in range(a + 1, model.ngeom):
                masks = (model.geom_contype[a] & model.geom_conaffinity[b]) | (
                    model.geom_contype[b] & model.geom_conaffinity[a]
                )
                one, other = weld[model.geom_bodyid[a]], weld[model.geom_bodyid[b]]
                # MuJoCo's filter: no contact between a body and its parent, unless that is the world
                kin = one and other and (weld[parent[one]] == other or weld[parent[other]] == one)
                if masks and one != other and not kin:
                    pairs.append((a, b))
        return pairs

    def _joint_of_actuators(self) -> list[int | None]:
        return [
            int(self.model.actuator_trnid[i, 0]) if self.model.actuator_trntype[i] in _JOINT_TRANSMISSIONS else None
            for i in range(self.model.nu)
        ]
