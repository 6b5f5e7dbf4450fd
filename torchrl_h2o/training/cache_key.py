"""Keys of the results that runs share in the cache: recordings, and the reports of ``mend``.

A key changes with all that the result depends on: settings, the compiled MuJoCo model, this library's code and the
versions of the packages that compute it. The code of an env class outside this library is not part of it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from torchrl.envs import EnvBase

import torchrl_h2o
from torchrl_h2o.envs import mujoco_model

SIMULATES = ("effects", "envs", "data")  # sub-packages whose code makes a recording
SEARCHES = (*SIMULATES, "residuals")  # and those of a search for effects
SOURCES = (".py", ".xml", ".yaml")
LIBRARIES = ("mujoco", "gymnasium", "dm-control", "numpy", "scipy", "torch")


def begin_key(settings: Any, env: EnvBase, packages: Sequence[str]) -> hashlib._Hash:
    """Hashes settings, the model of an env, and the code that computes the result; data may be added.

    Args:
        settings: what JSON can hold.
        env: the env with its effects.
        packages: sub-packages of this library that compute the result.
    """
    key = hashlib.sha256(json.dumps([settings, code_of(tuple(packages))], sort_keys=True).encode())
    key.update(_model_of(env))
    return key


@cache
def code_of(packages: tuple[str, ...]) -> str:
    """Identifies the code of sub-packages, and the installed versions of the packages that they use."""
    root = Path(torchrl_h2o.__file__).parent
    code = hashlib.sha256()
    for path in sorted(path for name in packages for path in (root / name).rglob("*") if path.suffix in SOURCES):
        code.update(str(path.relative_to(root)).encode() + path.read_bytes())
    for name in LIBRARIES:
        code.update(f"{name} {_version(name)}".encode())
    return code.hexdigest()


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:  # an extra that is not installed
        return ""


def _model_of(env: EnvBase) -> bytes:
    """The compiled model, as MuJoCo saves it; empty for an env that does not run on MuJoCo."""
    try:
        model = mujoco_model(env)
    except ValueError:
        return b""
    buffer = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()
