"""What can differ between two dynamics: effects, each one physical cause with units and bounds.

Needs mujoco and numpy, no torch. Effects compose: the model is edited in the effects' order and then
compiled once, actions and observations pass through their effects in order, forces are summed.
"""

from torchrl_h2o.effects.action import ActionDelay, ActionGain, ActionNoise
from torchrl_h2o.effects.body import BodyMass
from torchrl_h2o.effects.effect import (
    ActionEffect,
    Effect,
    ForceEffect,
    ModelEffect,
    ObservationEffect,
    Parameter,
    compile_model,
    parameter,
)
from torchrl_h2o.effects.entries import Indices
from torchrl_h2o.effects.force import JointForce, LinearDrag
from torchrl_h2o.effects.geom import GeomFriction, GeomLength, GeomSize, RollingResistance
from torchrl_h2o.effects.gravity import Gravity
from torchrl_h2o.effects.joint import (
    Armature,
    JointDamping,
    JointFrictionLoss,
    JointRange,
    JointStiffness,
)
from torchrl_h2o.effects.observation import ObservationBias, ObservationNoise
from torchrl_h2o.effects.paper_gaps import PAPER_GAPS, PaperGap, paper_gap
from torchrl_h2o.effects.selection import Names

__all__ = [
    "PAPER_GAPS",
    "ActionDelay",
    "ActionEffect",
    "ActionGain",
    "ActionNoise",
    "Armature",
    "BodyMass",
    "Effect",
    "ForceEffect",
    "GeomFriction",
    "GeomLength",
    "GeomSize",
    "Gravity",
    "Indices",
    "JointDamping",
    "JointForce",
    "JointFrictionLoss",
    "JointRange",
    "JointStiffness",
    "LinearDrag",
    "ModelEffect",
    "Names",
    "ObservationBias",
    "ObservationEffect",
    "ObservationNoise",
    "PaperGap",
    "Parameter",
    "RollingResistance",
    "compile_model",
    "paper_gap",
    "parameter",
]
