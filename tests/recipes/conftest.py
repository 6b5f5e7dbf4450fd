"""The modules of the benchmarks go by their bare names, as in the scripts that stand beside them."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2] / "recipes" / "benchmarks"))
