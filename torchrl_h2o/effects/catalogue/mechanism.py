"""Properties of a compiled model from which the entries of a catalogue and their trial values are derived.

These are floating roots, planar motion, possible contacts, and the magnitudes of torques and inertias.
"""

import mujoco
import numpy as np

# arm in m; the weight times this lever is the typical torque on a hinge without an actuator
_LEVER = 0.1
# deviation of a direction cosine from 0 or 1 below which an axis is perpendicular or parallel to the y axis
_ALIGNED = 1e-3
# converted to integers, because MuJoCo's constants do not compare equal to a model's integers inside tuples
_FREE, _HINGE, _SLIDE = (int(getattr(mujoco.mjtJoint, f"mjJNT_{kind}")) for kind in ("FREE", "HINGE", "SLIDE"))
_JOINT_TRANSMISSIONS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_ROUND = tuple(int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}")) for kind in ("SPHERE", "CYLINDER", "ELLIPSOID"))


class Mechanism:
    """Facts about a model at its initial position.

    Args:
        model: the compiled model.
    """

    def __init__(self, model: mujoco.MjModel):
        self.model = model
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        self._axes = data.xaxis.copy()
        self.single_joints = [j for j in range(model.njnt) if model.jnt_type[j] in (_HINGE, _SLIDE)]
        self.mass = float(model.body_mass.sum())
        self.weight = self.mass * float(np.linalg.norm(model.opt.gravity))

    def driven(self, joint: int) -> bool:
        """Whether an actuator acts on this joint alone."""
        return joint in self._joint_of_actuators()

    def actuator_label(self, actuator: int) -> str:
        """Returns the name of an actuator, or of the joint that it drives."""
        name, joint = self.model.actuator(actuator).name, self.joint_of(actuator)
        return name or (self.model.joint(joint).name if joint is not None else "")

    def floating(self, joint: int) -> bool:
        """Whether a joint lets the whole mechanism float. Such a joint is not a bearing and has no friction or spring.

        Floating joints are free joints, and groups of at least two undriven joints between the world and one body, if
        the group contains a sliding joint.
        """
        model, body = self.model, self.model.jnt_bodyid[joint]
        if model.jnt_type[joint] == _FREE:
            return True
        mates = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
        if model.body_parentid[body] != 0 or len(mates) < 2 or any(self.driven(mate) for mate in mates):
            return False
        return any(self.slides(mate) for mate in mates)

    def planar(self, body: int) -> bool:
        """Whether a body moves only in the x-z plane: all joints up to the world slide in it or rotate about y."""
        while body:
            first = self.model.body_jntadr[body]
            for joint in range(first, first + self.model.body_jntnum[body]):
                along_y = abs(self._axes[joint][1])
                kind = self.model.jnt_type[joint]
                if not ((kind == _HINGE and along_y > 1.0 - _ALIGNED) or (kind == _SLIDE and along_y < _ALIGNED)):
                    return False
            body = self.model.body_parentid[body]
        return True

    def is_link(self, body: int) -> bool:
        """Whether a body carries joints of other bodies and does not float."""
        model = self.model
        own = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
        carries = any(model.body_parentid[child] == body and model.body_jntnum[child] for child in range(model.nbody))
        return carries and bool(model.body_weldid[body]) and not any(self.floating(joint) for joint in own)

    def axes(self, body: int) -> tuple[str, ...]:
        """Returns the axes of a body's frame along which a shift of its mass has an effect."""
        return ("x", "z") if self.planar(body) else ("x", "z", "y")

    def slides(self, joint: int) -> bool:
        """Whether a joint is a sliding joint."""
        return self.model.jnt_type[joint] == _SLIDE

    def wheel(self, geom: int) -> bool:
        """Whether a geom can roll: a round geom on a body with an unlimited hinge."""
        model, body = self.model, self.model.geom_bodyid[geom]
        joints = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
        turning = any(model.jnt_type[j] == _HINGE and not model.jnt_limited[j] for j in joints)
        return turning and model.geom_type[geom] in _ROUND and not any(self.floating(j) for j in joints)

    def torque(self, joint: int) -> float:
        """Returns the largest torque in N·m (force in N) that is typical of a joint.

        It is the limit of the joint's actuators; without one, the weight times the lever (the weight).
        """
        largest = 0.0
        for actuator, target in enumerate(self._joint_of_actuators()):
            if target == joint:
                largest += abs(self.model.actuator_gear[actuator, 0]) * self.control(actuator)
        lever = _LEVER if self.model.jnt_type[joint] == _HINGE else 1.0
        return largest or self.weight * lever or 1.0

    def control(self, actuator: int) -> float:
        """Returns the largest magnitude of an actuator's control; 1 if the control has no limit."""
        if not self.model.actuator_ctrllimited[actuator]:
            return 1.0
        return float(np.abs(self.model.actuator_ctrlrange[actuator]).max())

    def inertia(self, joint: int) -> float:
        """Returns the inertia of the mechanism about a joint, in kg·m² (kg for a sliding joint)."""
        return float(self.model.dof_M0[self.model.jnt_dofadr[joint]])

    def radius_of_gyration(self, body: int) -> float:
        """Returns the square root of a body's largest moment of inertia over its mass, in m."""
        return float(np.sqrt(self.model.body_inertia[body].max() / self.model.body_mass[body]))

    def touching(self) -> list[tuple[int, int]]:
        """Returns the pairs of geoms whose masks allow a collision, on bodies that move relative to each other."""
        model, pairs = self.model, []
        weld, parent = model.body_weldid, model.body_parentid
        for a in range(model.ngeom):
            for b in range(a + 1, model.ngeom):
                masks = (model.geom_contype[a] & model.geom_conaffinity[b]) | (
                    model.geom_contype[b] & model.geom_conaffinity[a]
                )
                one, other = weld[model.geom_bodyid[a]], weld[model.geom_bodyid[b]]
                # MuJoCo's filter excludes contacts between a body and its parent, unless the parent is the world
                kin = one and other and (weld[parent[one]] == other or weld[parent[other]] == one)
                if masks and one != other and not kin:
                    pairs.append((a, b))
        return pairs

    def joint_of(self, actuator: int) -> int | None:
        """The joint that an actuator acts on; None if it acts on several or on none."""
        return self._joint_of_actuators()[actuator]

    def _joint_of_actuators(self) -> list[int | None]:
        return [
            int(self.model.actuator_trnid[i, 0]) if self.model.actuator_trntype[i] in _JOINT_TRANSMISSIONS else None
            for i in range(self.model.nu)
        ]
