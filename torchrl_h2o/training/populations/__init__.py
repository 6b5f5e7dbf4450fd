"""Many runs in one process, with stacked networks whose losses are computed in one call."""

from torchrl_h2o.training.populations.population import Population
from torchrl_h2o.training.populations.replay import PopulationReplay

__all__ = ["Population", "PopulationReplay"]
