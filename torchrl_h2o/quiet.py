"""Imported first by a recipe: keeps other packages' warnings and notices off its user's terminal.

What this project has to say comes as an error that says what to do. PYTHONWARNINGS and RL_LOGGING_LEVEL=INFO bring the
rest back.
"""

import os
import sys
import warnings

if not sys.warnoptions:
    warnings.filterwarnings("ignore")
os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")
