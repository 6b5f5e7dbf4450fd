"""What produced a result: commit, versions of the packages, CPU seconds, and the processor's instruction set."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

import torchrl_h2o

PACKAGES = ("torch", "torchrl", "tensordict", "gymnasium", "mujoco")


def provenance(since: float = 0.0) -> dict[str, Any]:
    """Describes the code and the machine that produce a result, as entries of a result file.

    Args:
        since: :func:`cpu_seconds` where the work began, in s; 0 counts from the start of the process.

    Returns:
        ``versions`` of Python, this library and the packages on which numbers depend; ``commit`` and ``dirty`` (files
        outside recipes/results differ from it), both None where the library does not run from its repository;
        ``cpu_s``, the CPU time used since then, in s; ``threads`` of torch; and
        ``instruction_set``, by which torch rounds: DEFAULT, AVX2 or AVX512.

    Examples:
        >>> sorted(provenance())
        ['commit', 'cpu_s', 'dirty', 'instruction_set', 'threads', 'versions']
    """
    commit, dirty = _commit()
    return {
        "commit": commit,
        "dirty": dirty,
        "versions": _versions(),
        "cpu_s": round(cpu_seconds() - since, 3),
        "threads": torch.get_num_threads(),
        "instruction_set": torch.backends.cpu.get_cpu_capability(),
    }


def cpu_seconds() -> float:
    """CPU time that this process and its ended children have used, in s."""
    return time.process_time() + sum(os.times()[2:4])


def _versions() -> dict[str, str]:
    found = {"python": sys.version.split()[0], "torchrl_h2o": torchrl_h2o.__version__}  # it need not be installed
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # the losses alone need neither gymnasium nor mujoco
            continue
    return found


def _commit() -> tuple[str | None, bool | None]:
    git, own = ["git", "-C", str(Path(__file__).parent)], Path(__file__).name
    told: dict[str, Any] = {"capture_output": True, "text": True, "check": True}
    try:  # an installed library may be inside a repository of the user, which does not track it
        subprocess.run([*git, "ls-files", "--error-unmatch", own], **told)
        commit = subprocess.run([*git, "rev-parse", "--short", "HEAD"], **told).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None, None
    unchanged = [*git, "diff", "--quiet", "HEAD", "--", ":/", ":(exclude,top)recipes/results"]
    return commit, subprocess.run(unchanged, check=False).returncode != 0
