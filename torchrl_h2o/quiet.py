"""Silences warnings and log messages of other packages; import it before them.

Scripts and console commands import it, the library does not. PYTHONWARNINGS and RL_LOGGING_LEVEL=INFO restore the
messages.
"""

import os
import sys
import warnings

if not sys.warnoptions:
    warnings.filterwarnings("ignore")
os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")
