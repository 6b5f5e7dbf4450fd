"""Types and bounds of the commands' options, as pydantic models; the YAML files have their defaults and comments."""

from torchrl_h2o.options.check import check_options
from torchrl_h2o.options.close_the_loop import CloseTheLoopOptions
from torchrl_h2o.options.evaluate import EvaluateOptions
from torchrl_h2o.options.run import RunOptions
from torchrl_h2o.options.train import AnyMethodOptions, TrainOptions
from torchrl_h2o.options.types import Options

__all__ = [
    "AnyMethodOptions",
    "CloseTheLoopOptions",
    "EvaluateOptions",
    "Options",
    "RunOptions",
    "TrainOptions",
    "check_options",
]
