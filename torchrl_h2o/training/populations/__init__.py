"""Many runs in one process: their networks stacked, their losses computed in one call."""

from torchrl_h2o.training.populations.population import Population
from torchrl_h2o.training.populations.replay import PopulationReplay

__all__ = ["Population", "PopulationReplay"]
