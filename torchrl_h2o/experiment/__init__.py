"""Designs experiments: the commands that tell apart what a report leaves open, and those of a first log."""

from torchrl_h2o.experiment.expected import as_ted, joined
from torchrl_h2o.experiment.experiment import Experiment
from torchrl_h2o.experiment.limits import Envelope
from torchrl_h2o.experiment.next_experiment import next_experiment
from torchrl_h2o.experiment.plan_experiment import plan_experiment

__all__ = ["Envelope", "Experiment", "as_ted", "joined", "next_experiment", "plan_experiment"]
