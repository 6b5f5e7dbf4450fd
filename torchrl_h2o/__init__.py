"""H2O+ as modular TorchRL parts: losses, dynamics gaps and measured data.

The top level imports nothing but the version: :mod:`torchrl_h2o.objectives` needs torch, tensordict
and torchrl alone, :mod:`torchrl_h2o.envs` also MuJoCo, :mod:`torchrl_h2o.data` also Minari and h5py.
"""

__version__ = "0.1.0"
