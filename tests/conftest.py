"""Settings for all tests: one thread per worker, and no time limit on Hypothesis examples."""

import os

os.environ["OMP_NUM_THREADS"] = "1"  # read when torch and NumPy load, here and in the processes that tests start

import torch
from hypothesis import settings

pytest_plugins = ["tests.run_fixtures"]

torch.set_num_threads(1)
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")
