"""Effects: named physical causes by which two dynamics differ, with units and bounds.

Requires mujoco and numpy, but not torch. Effects compose: the model is edited in the effects' order and then compiled
once, actions and observations pass through their effects in order, and forces are summed.
"""

from torchrl_h2o.effects.action.play import ActionBacklash, ActionDeadBand, ActionSaturation
from torchrl_h2o.effects.action.signal import ActionBias, ActionGain, ActionNoise
from torchrl_h2o.effects.action.timing import ActionDelay, ActionLag, ActionLead
from torchrl_h2o.effects.catalogue.catalogue import catalogue
from torchrl_h2o.effects.catalogue.entry import CatalogueEntry
from torchrl_h2o.effects.catalogue.plausibility import is_negligible
from torchrl_h2o.effects.effect import (
    ActionEffect,
    Effect,
    ForceEffect,
    ModelEffect,
    ObservationEffect,
    VaryingEffect,
)
from torchrl_h2o.effects.force.drag import JointForce, LinearDrag, QuadraticDrag
from torchrl_h2o.effects.force.residual_force import ResidualForce
from torchrl_h2o.effects.force.servo import ServoDeadBand, TorqueSpeedLine
from torchrl_h2o.effects.gear.friction import LoadFriction, StribeckFriction
from torchrl_h2o.effects.gear.play import GearPlay
from torchrl_h2o.effects.joint_units import joint_names, quantity_name
from torchrl_h2o.effects.model.body import BodyCentreOfMass, BodyInertia, BodyMass, Payload, PseudoInertia
from torchrl_h2o.effects.model.capsules import EarlierCapsules
from torchrl_h2o.effects.model.compilation import compile_model
from torchrl_h2o.effects.model.geom import (
    CapsuleLength,
    ContactSoftness,
    GeomFriction,
    GeomLength,
    GeomSize,
    RollingResistance,
)
from torchrl_h2o.effects.model.joint import (
    Armature,
    JointDamping,
    JointFrictionLoss,
    JointRange,
    JointRest,
    JointSpring,
    JointStiffness,
)
from torchrl_h2o.effects.model.link import LinkLength, LinkTurn
from torchrl_h2o.effects.model.servo import ActuatorTimeConstant, ServoDamping, ServoStiffness
from torchrl_h2o.effects.model.world import Gravity, GravityTilt, Timestep
from torchrl_h2o.effects.noise_balance import balanced
from torchrl_h2o.effects.observation.sensor import ObservationBias, ObservationDelay, ObservationGain, ObservationNoise
from torchrl_h2o.effects.paper_gaps import PAPER_GAPS, PaperGap, paper_gap
from torchrl_h2o.effects.parameter import Parameter, parameter
from torchrl_h2o.effects.pipeline import Episode, Pipeline
from torchrl_h2o.effects.selection import Indices, Names
from torchrl_h2o.effects.serialisation import effect_from_dict, effect_to_dict

__all__ = [
    "PAPER_GAPS",
    "ActionBacklash",
    "ActionBias",
    "ActionDeadBand",
    "ActionDelay",
    "ActionEffect",
    "ActionGain",
    "ActionLag",
    "ActionLead",
    "ActionNoise",
    "ActionSaturation",
    "ActuatorTimeConstant",
    "Armature",
    "BodyCentreOfMass",
    "BodyInertia",
    "BodyMass",
    "CapsuleLength",
    "CatalogueEntry",
    "ContactSoftness",
    "EarlierCapsules",
    "Effect",
    "Episode",
    "ForceEffect",
    "GearPlay",
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
    "LinkLength",
    "LinkTurn",
    "LoadFriction",
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
    "Pipeline",
    "PseudoInertia",
    "QuadraticDrag",
    "ResidualForce",
    "RollingResistance",
    "ServoDamping",
    "ServoDeadBand",
    "ServoStiffness",
    "StribeckFriction",
    "Timestep",
    "TorqueSpeedLine",
    "VaryingEffect",
    "balanced",
    "catalogue",
    "compile_model",
    "effect_from_dict",
    "effect_to_dict",
    "is_negligible",
    "joint_names",
    "paper_gap",
    "parameter",
    "quantity_name",
]
