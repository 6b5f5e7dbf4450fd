"""Console commands of the package: ``close-the-loop`` and ``h2o-evaluate``."""

from importlib.util import find_spec

import torchrl_h2o.quiet  # noqa: F401  (first, since the commands import packages whose warnings it silences)

if find_spec("hydra") is None:
    raise ModuleNotFoundError("the console commands need Hydra: pip install 'torchrl_h2o[recipes]'")
