"""Results that runs share: recordings, and the reports of ``mend``. The first run makes one, the others wait for it.

The key of a result changes with all that it depends on: settings, data, the compiled MuJoCo model, this library's code
and the versions of the packages that compute it. The code of an env class outside this library is not part of it.
``joblib.Memory`` has no lock between processes and knows a function's own code alone, so it would not replace this.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from filelock import FileLock
from torchrl.envs import EnvBase

import torchrl_h2o
from torchrl_h2o.envs import mujoco_model

SIMULATES = ("effects", "envs", "data")  # sub-packages whose code makes a recording
SEARCHES = (*SIMULATES, "residuals")  # and those of a search for effects
SOURCES = (".py", ".xml", ".yaml")
LIBRARIES = ("mujoco", "gymnasium", "dm-control", "numpy", "scipy", "torch")


def cache_folder() -> Path:
    """Folder for what runs share."""
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(home) / "torchrl_h2o"


def cached(folder: Path, make: Callable[[Path], Any]) -> Path:
    """Makes a folder unless another process has made it, which is waited for.

    Args:
        folder: the folder, with a name from :func:`key_of`.
        make: writes the folder, whole or not at all.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(folder.with_name(f"{folder.name}.lock")):  # several runs of a grid may begin at once
        if not folder.exists():
            make(folder)
    return folder


def key_of(settings: Any, env: EnvBase, packages: Sequence[str], data: Iterable[bytes] = ()) -> str:
    """Identifies a result by settings, data, the model of an env, and the code that computes it.

    Args:
        settings: what JSON can hold.
        env: the env with its effects.
        packages: sub-packages of this library that compute the result.
        data: further values on which it depends.
    """
    key = hashlib.sha256(json.dumps([settings, _code_of(tuple(packages))], sort_keys=True).encode())
    for part in (_model_of(env), *data):
        key.update(part)
    return key.hexdigest()[:16]


@cache
def _code_of(packages: tuple[str, ...]) -> str:
    """Identifies the code of sub-packages, and the installed versions of the packages that they use."""
    root = Path(torchrl_h2o.__file__).parent
    code = hashlib.sha256()
    for path in sorted(path for name in packages for path in (root / name).rglob("*") if path.suffix in SOURCES):
        code.update(str(path.relative_to(root)).encode() + path.read_bytes())
    for name in LIBRARIES:
        try:
            code.update(f"{name} {version(name)}".encode())
        except PackageNotFoundError:  # an extra that is not installed
            continue
    return code.hexdigest()


def _model_of(env: EnvBase) -> bytes:
    """The compiled model, as MuJoCo saves it; empty for an env that does not run on MuJoCo."""
    try:
        model = mujoco_model(env)
    except ValueError:
        return b""
    buffer = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()
