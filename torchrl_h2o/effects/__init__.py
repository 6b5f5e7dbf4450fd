"""What can differ between two dynamics: effects, each one physical cause with units and bounds.

Needs mujoco and numpy, no torch. Effects compose: the model is edited in the effects' order and then
compiled once, actions and observations pass through their effects in order, forces are summed.
"""

from torchrl_h2o.effects.action import ActionBias, ActionGain, ActionNoise
from torchrl_h2o.effects.actuator_dynamics import ActionDelay, ActionLag
from torchrl_h2o.effects.actuator_play import ActionBacklash, ActionDeadBand, ActionSaturation
from torchrl_h2o.effects.body import BodyCentreOfMass, BodyInertia, BodyMass, Payload
from torchrl_h2o.effects.catalogue import catalogue
from torchrl_h2o.effects.catalogue_entry import CatalogueEntry
from torchrl_h2o.effects.contact import ContactSoftness, RollingResistance
from torchrl_h2o.effects.effect import (
    ActionEffect,
    Effect,
    ForceEffect,
    ModelEffect,
    ObservationEffect,
    compile_model,
)
from torchrl_h2o.effects.effect_dict import effect_from_dict, effect_to_dict
from torchrl_h2o.effects.entries import Indices
from torchrl_h2o.effects.force import JointForce, LinearDrag, QuadraticDrag
from torchrl_h2o.effects.geom import GeomFriction, GeomLength, GeomSize
from torchrl_h2o.effects.gravity import Gravity, GravityTilt
from torchrl_h2o.effects.joint import (
    Armature,
    JointDamping,
    JointFrictionLoss,
    JointRange,
)
from torchrl_h2o.effects.joint_spring import JointRest, JointSpring, JointStiffness
from torchrl_h2o.effects.noise_balance import balanced
from torchrl_h2o.effects.observation import ObservationBias, ObservationDelay, ObservationGain, ObservationNoise
from torchrl_h2o.effects.paper_gaps import PAPER_GAPS, PaperGap, paper_gap
from torchrl_h2o.effects.parameter import Parameter, parameter
from torchrl_h2o.effects.residual_force import ResidualForce
from torchrl_h2o.effects.selection import Names
from torchrl_h2o.effects.timestep import Timestep

__all__ = [
    "PAPER_GAPS",
    "ActionBacklash",
    "ActionBias",
    "ActionDeadBand",
    "ActionDelay",
    "ActionEffect",
    "ActionGain",
    "ActionLag",
    "ActionNoise",
    "ActionSaturation",
    "Armature",
    "BodyCentreOfMass",
    "BodyInertia",
    "BodyMass",
    "CatalogueEntry",
    "ContactSoftness",
    "Effect",
    "ForceEffect",
    "GeomFriction",
    "GeomLength",
    "GeomSize",
    "Gravity",
    "GravityTilt",
    "Indices",
    "JointDamping",
    "JointForce",
    "JointFrictionLoss",
    "JointRange",
    "JointRest",
    "JointSpring",
    "JointStiffness",
    "LinearDrag",
    "ModelEffect",
    "Names",
    "ObservationBias",
    "ObservationDelay",
    "ObservationEffect",
    "ObservationGain",
    "ObservationNoise",
    "PaperGap",
    "Parameter",
    "Payload",
    "QuadraticDrag",
    "ResidualForce",
    "RollingResistance",
    "Timestep",
    "balanced",
    "catalogue",
    "compile_model",
    "effect_from_dict",
    "effect_to_dict",
    "paper_gap",
    "parameter",
]
