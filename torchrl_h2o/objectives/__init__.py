"""Losses of H2O+, and parts of DARC, DARA, H2O, PAR, ReBRAC and VGDF. Needs only torch, tensordict and torchrl."""

from torchrl_h2o.objectives.accelerated_cql import AcceleratedCQLLoss
from torchrl_h2o.objectives.bellman import MixedBellmanLoss
from torchrl_h2o.objectives.conservative import ConservativeLoss, DynamicsDivergence
from torchrl_h2o.objectives.dynamics_model import DynamicsModelLoss
from torchrl_h2o.objectives.exploration import EntropyBonus
from torchrl_h2o.objectives.h2o_plus import H2OPlusLoss
from torchrl_h2o.objectives.hybrid_loss import HybridLoss, total_loss
from torchrl_h2o.objectives.importance import ImportanceWeightedLoss
from torchrl_h2o.objectives.networks import (
    make_actor,
    make_dynamics_model,
    make_dynamics_ratio_estimator,
    make_qvalue,
    make_representation_deviation,
    make_value,
)
from torchrl_h2o.objectives.ratio import DynamicsRatioEstimator, DynamicsRatioLoss, fit_change_scale
from torchrl_h2o.objectives.rebrac import ReBRACLoss
from torchrl_h2o.objectives.representation import RepresentationDeviation, RepresentationLoss
from torchrl_h2o.objectives.reward_correction import DynamicsRewardCorrection
from torchrl_h2o.objectives.value import (
    ExpectileValueLoss,
    ExponentialValueLoss,
    InSampleValueLoss,
    SparseValueLoss,
)
from torchrl_h2o.objectives.value_filter import ValueGuidedFilter

__all__ = [
    "AcceleratedCQLLoss",
    "ConservativeLoss",
    "DynamicsDivergence",
    "DynamicsModelLoss",
    "DynamicsRatioEstimator",
    "DynamicsRatioLoss",
    "DynamicsRewardCorrection",
    "EntropyBonus",
    "ExpectileValueLoss",
    "ExponentialValueLoss",
    "H2OPlusLoss",
    "HybridLoss",
    "ImportanceWeightedLoss",
    "InSampleValueLoss",
    "MixedBellmanLoss",
    "ReBRACLoss",
    "RepresentationDeviation",
    "RepresentationLoss",
    "SparseValueLoss",
    "ValueGuidedFilter",
    "fit_change_scale",
    "make_actor",
    "make_dynamics_model",
    "make_dynamics_ratio_estimator",
    "make_qvalue",
    "make_representation_deviation",
    "make_value",
    "total_loss",
]
