"""The usual domain randomisation: every number of the simulator's model within a range, in place of a measured one."""

from __future__ import annotations

import mujoco
import numpy as np

from torchrl_h2o.effects import ActionGain, Armature, BodyMass, Effect, GeomFriction, JointDamping, JointFrictionLoss


def usual_world(model: mujoco.MjModel, rng: np.random.Generator, share: float) -> tuple[Effect, ...]:
    """Draws every mass, friction, damping, armature and actuator gain of a model within ± a share; zeros stay zero.

    Args:
        model: the model of the simulator.
        rng: draws uniformly, each number by itself; inertia changes with the mass.
        share: half width of the range, as a share of each number.
    """
    joints = [model.joint(i) for i in range(model.njnt)]
    added = ((JointDamping, "damping"), (JointFrictionLoss, "frictionloss"), (Armature, "armature"))
    scaled = (
        *(BodyMass(bodies=model.body(i).name) for i in range(1, model.nbody)),
        *(GeomFriction(geoms=model.geom(i).name) for i in range(model.ngeom) if model.geom_contype[i]),
        *(ActionGain(actuators=(i,)) for i in range(model.nu)),
    )
    return (
        *(effect.with_parameters({"scale": 1.0 + rng.uniform(-share, share)}) for effect in scaled),
        *(
            kind(float(rng.uniform(-share, share) * getattr(joint, field)[0]), joint.name)
            for joint in joints
            for kind, field in added
            if getattr(joint, field)[0]
        ),
    )
