"""Options that name a file, a folder or a data set, which must exist before a command begins its work."""

from __future__ import annotations

import glob
import os
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field

from torchrl_h2o.data.readers.load import looks_like_a_path
from torchrl_h2o.options.nearest import did_you_mean
from torchrl_h2o.options.types import not_there

RECORDED = "recorded"
PAPER_DATA = ("halfcheetah/medium-v0", "halfcheetah/medium-replay-v0", "walker2d/medium-replay-v0")
LAYOUTS = Path(__file__).parents[1] / "data" / "readers" / "logs"
MISSPELT = 0.9  # similarity from which a Minari name is a misspelling of a known one


def _beside(name: str) -> list[str]:
    """Files and folders in the folder of a path, with that folder as it was typed."""
    folder = os.path.dirname(name)
    there = Path(folder).expanduser()
    return [os.path.join(folder, one.name) for one in there.iterdir()] if there.is_dir() else []


def require_path(name: str) -> str:
    """Requires a file or folder that exists.

    Raises:
        PydanticCustomError: if it does not, with the most similar name in the same folder.
    """
    path = Path(name).expanduser()
    if path.is_file() or path.is_dir():
        return name
    if path.exists():  # reading it may never end
        raise ValueError("it is a device or a pipe, not a file or folder")
    raise not_there(f"there is no such file or folder{did_you_mean(name, _beside(name))}")


def require_run(name: str) -> str:
    """Requires the folder of a run, which contains ``config.yaml``.

    Raises:
        PydanticCustomError: if there is no such folder, or it is not the folder of a run.
    """
    if (Path(name) / "config.yaml").exists():
        return name
    near = did_you_mean(name, [one for one in _beside(name) if os.path.exists(os.path.join(one, "config.yaml"))])
    raise not_there(f"it is not the folder of a run, which has a config.yaml{near}")


def require_layout(name: str) -> str:
    """Requires the YAML file of a log's columns, or the name of a layout of the package.

    Raises:
        PydanticCustomError: if there is neither.
    """
    layouts = [path.stem for path in LAYOUTS.glob("*.yaml")]
    if name in layouts or Path(name).expanduser().exists():
        return name
    near = did_you_mean(name, [*_beside(name), *layouts])
    raise not_there(f"there is no such file, and the library's layouts are {', '.join(sorted(layouts))}{near}")


def require_data(name: str) -> str:
    """Requires a source of data: ``recorded``, a file, a folder, a glob with matches, or a name of Minari's.

    A Minari name that is not on this machine is downloaded later. Here it is refused if it is nearly that of a data
    set on this machine or of the paper's, and not another version of it.

    Raises:
        PydanticCustomError: if there is no such source.
    """
    path = os.path.expanduser(name)
    if os.path.exists(path):
        return require_path(name)
    if name == RECORDED or any(glob.iglob(path, recursive=True)):
        return name
    if looks_like_a_path(name):
        raise not_there(f"there is no such file or folder{did_you_mean(name, [RECORDED, *_beside(name)])}")
    local = _minari_names()
    others = [one for one in (*local, *PAPER_DATA) if _without_version(one) != _without_version(name)]
    if name not in (*local, *PAPER_DATA) and (near := did_you_mean(name, others, MISSPELT)):
        raise not_there(f"there is no such data set on this machine{near}")
    return name


def _minari_names() -> list[str]:
    from minari.storage import get_dataset_path  # not needed by commands that name no data

    folder = get_dataset_path()
    return [one.parent.relative_to(folder).as_posix() for one in folder.glob("**/data") if one.is_dir()]


def _without_version(name: str) -> str:
    return name.rpartition("-v")[0]


def require_folder(name: str) -> str:
    """Requires a folder, or a name at which one can be made.

    Raises:
        ValueError: if there is a file, or the folder may not be written.
    """
    there = Path(name).expanduser().absolute()
    while not there.exists():
        there = there.parent
    if not there.is_dir() or not os.access(there, os.W_OK):
        raise ValueError(f"no folder can be made there, because {there} is a file or may not be written")
    return name


def require_mend(name: str) -> str:
    """Requires ``posterior``, or the file or folder of a report.

    Raises:
        PydanticCustomError: if there is no such file or folder.
    """
    return name if name == "posterior" else require_path(name)


Mend = (
    bool | Annotated[str, AfterValidator(require_mend), Field(description="posterior or the report.json of a search")]
)
NewFolder = Annotated[str, AfterValidator(require_folder)]
AnyPath = Annotated[str, AfterValidator(require_path)]
RunFolder = Annotated[str, AfterValidator(require_run)]
WarmStart = bool | Annotated[str, AfterValidator(require_run), Field(description="the folder of a run")]
Layout = Annotated[str, AfterValidator(require_layout)]
DataSource = Annotated[
    str, AfterValidator(require_data), Field(description="a file, a folder or the name of a data set")
]
Files = Annotated[dict[str, AnyPath], Field(min_length=2, description="the files of one run by name")]
Data = DataSource | Files | Annotated[list[DataSource | Files], Field(min_length=1, description="a list of these")]
