"""The number of a process that has ended, as a killed one leaves it in the names of its temporary files."""

import subprocess
import sys


def ended_process() -> int:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid
