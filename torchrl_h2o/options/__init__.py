"""The commands' options, as pydantic models: an option is one line with its type, bounds, default value and meaning."""

from torchrl_h2o.options.check import check_options
from torchrl_h2o.options.close_the_loop import CloseTheLoopOptions
from torchrl_h2o.options.defaults import store_defaults
from torchrl_h2o.options.evaluate import EvaluateOptions
from torchrl_h2o.options.run import RunOptions
from torchrl_h2o.options.train import AnyMethodOptions, SimToRealOptions, TrainOptions
from torchrl_h2o.options.types import Options

__all__ = [
    "AnyMethodOptions",
    "CloseTheLoopOptions",
    "EvaluateOptions",
    "Options",
    "RunOptions",
    "SimToRealOptions",
    "TrainOptions",
    "check_options",
]

for _name, _model in {
    "run_options": RunOptions,
    "train_options": TrainOptions,
    "sim_to_real_options": SimToRealOptions,
    "evaluate_options": EvaluateOptions,
    "close_the_loop_options": CloseTheLoopOptions,
}.items():
    store_defaults(_name, _model)
