"""Writes a specification as an MJCF file that loads again: with all digits, and with its meshes and textures beside it.

The file is written under a temporary name, loaded and compared before it replaces an earlier one.
"""

from __future__ import annotations

import ctypes
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from torchrl_h2o.effects.model.compilation import accepting_total_mass, compile_model
from torchrl_h2o.whole_file import whole_file

_DIGITS = 17  # of a float64 that is read back unchanged
_LONG_NUMBER = re.compile(r"-?\d+\.\d{12,}(?:e[-+]?\d+)?")
_COMPARED = re.compile(r"(body|dof|jnt|geom|actuator|eq|tendon|pair|key)_|qpos")
_NOT_COMPARED = re.compile(r"adr|num|user|rgba|plugin|name|group|matid|aabb|rbound|bvh|history|signature")


def write_mjcf(spec: mujoco.MjSpec, path: str | Path) -> Path:
    """Writes a specification as an MJCF file, whose assets are copied into the folder ``<stem>_assets`` beside it.

    Args:
        spec: the specification; its names of files change to those of the copies.
        path: the file; an existing one is replaced when the new one is complete.

    Returns:
        The path.

    Raises:
        ValueError: if MuJoCo's text does not give the same model again. The earlier file, if any, stays.
        OSError: if a file cannot be read or written.

    Examples:
        >>> import tempfile
        >>> spec = mujoco.MjSpec.from_string("<mujoco><option gravity='0 0 -1.234567890123'/></mujoco>")
        >>> path = write_mjcf(spec, Path(tempfile.mkdtemp()) / "mended.xml")
        >>> float(mujoco.MjModel.from_xml_path(str(path)).opt.gravity[2])
        -1.234567890123
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    model = compile_model(spec)
    _copy_assets(spec, path.parent, f"{path.stem}_assets")
    compile_model(spec)  # MuJoCo writes a specification that is compiled
    with _all_digits(), accepting_total_mass():
        text = spec.to_xml()
    with whole_file(path) as partial:
        partial.write_text(_LONG_NUMBER.sub(lambda number: repr(float(number[0])), text), encoding="utf-8")
        _require_equal(mujoco.MjModel.from_xml_path(str(partial)), model)
    return path


def _copy_assets(spec: mujoco.MjSpec, folder: Path, name: str) -> None:
    """Copies all files that a specification refers to, and makes it refer to the copies."""
    names: dict[str, str] = {}  # by source
    meshes = [(element, spec.meshdir) for element in (*spec.meshes, *spec.hfields, *spec.skins)]
    for element, directory in (*meshes, *((texture, spec.texturedir) for texture in spec.textures)):
        if element.file:
            element.file = _copied(spec, element.file, directory, folder, name, names)
    for texture in spec.textures:
        files = list(texture.cubefiles)
        if any(files):
            texture.cubefiles = [
                _copied(spec, file, spec.texturedir, folder, name, names) if file else "" for file in files
            ]
    if names:
        spec.meshdir = spec.texturedir = ""
        spec.modelfiledir = str(folder)
        spec.strippath = False


def _copied(spec: mujoco.MjSpec, file: str, directory: str, folder: Path, name: str, names: dict[str, str]) -> str:
    """Copies one file into the folder of the assets, unless that has been done, and returns its new name."""
    file = Path(file).name if spec.strippath else file
    content: Any = next((spec.assets[key] for key in (file, str(Path(directory, file))) if key in spec.assets), None)
    source = str(Path(spec.modelfiledir, directory, file))
    if source not in names:
        own = Path(file).name
        if f"{name}/{own}" in names.values():
            own = f"{len(names)}_{own}"
        with whole_file(folder / name / own) as partial:
            if content is None:
                shutil.copyfile(source, partial)
            else:
                partial.write_bytes(content if isinstance(content, bytes) else str(content).encode())
        names[source] = f"{name}/{own}"
    return names[source]


@contextmanager
def _all_digits() -> Iterator[None]:
    """Makes MuJoCo write numbers with all digits instead of six, if this version of it can."""
    found = next(Path(mujoco.__file__).parent.glob("*mujoco.*so*"), None) or next(
        Path(mujoco.__file__).parent.glob("*mujoco*.dylib"), None
    )
    library = None if found is None else ctypes.CDLL(str(found))
    if library is None or not hasattr(library, "_mjPRIVATE__set_xml_precision"):
        yield  # six digits, so the predictions agree to about 1e-6
        return
    before = library._mjPRIVATE__get_xml_precision()
    library._mjPRIVATE__set_xml_precision(_DIGITS)
    try:
        yield
    finally:
        library._mjPRIVATE__set_xml_precision(before)


def _require_equal(loaded: mujoco.MjModel, model: mujoco.MjModel) -> None:
    """Raises ValueError if the dynamics of two models differ by more than the rounding of a text with six digits."""
    fields = [name for name in dir(model) if _COMPARED.match(name) and not _NOT_COMPARED.search(name)]
    for name in fields:
        ours, theirs = getattr(model, name), getattr(loaded, name)
        if isinstance(ours, np.ndarray) and not _equal(ours, theirs):
            raise ValueError(f"MuJoCo's text of this model gives another {name} when it is read")
    for name in ("gravity", "timestep", "wind", "density", "viscosity", "integrator", "cone", "disableflags"):
        if not _equal(np.asarray(getattr(model.opt, name)), np.asarray(getattr(loaded.opt, name))):
            raise ValueError(f"MuJoCo's text of this model gives another {name} when it is read")


def _equal(ours: np.ndarray, theirs: np.ndarray) -> bool:
    if ours.shape != theirs.shape:
        return False
    if not np.issubdtype(ours.dtype, np.number):
        return bool((ours == theirs).all())
    size = np.abs(ours).max(initial=0.0)
    return bool(np.allclose(ours, theirs, rtol=1e-4, atol=1e-5 * size, equal_nan=True))
