"""Types of options that several commands share: numbers with bounds, and names out of a table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import torch
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, GetCoreSchemaHandler
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from torchrl_h2o.effects import PAPER_GAPS


class Options(BaseModel):
    """Options of a command: unknown ones are refused, and text is not converted to numbers."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


def option(default: Any, text: str = "") -> Any:
    """An option with its default value, and what it is, in words for ``--help``."""
    return Field(default, json_schema_extra={"help": text})


@dataclass(frozen=True)
class OneOf:
    """Accepts the names of a table, such as the paper's gaps; a ``Literal`` whose values are known at run time.

    Args:
        names: the accepted names.
    """

    names: tuple[str, ...]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.literal_schema(list(self.names))


MOST = 10_000  # worlds, frames, episodes at once: beyond it is a slip, or a file made to take all memory

Count = Annotated[int, Field(ge=1)]
Few = Annotated[int, Field(ge=1, le=MOST)]
Seed = Annotated[int, Field(ge=0, le=2**32 - 1)]  # NumPy's and Gymnasium's generators accept no larger ones
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Inside = Annotated[float, Field(gt=0, lt=1)]
Gap = Annotated[str, OneOf(tuple(PAPER_GAPS))]
Rows = Annotated[
    list[Count],
    Field(min_length=2, max_length=2, description="two integers of at least 1, [real,simulated], such as [128,128]"),
]
Trust = Annotated[bool | list[str], Field(description="true, false or names, such as [my_package.MyEnv]")]
Widths = Annotated[
    list[Annotated[int, Field(ge=1, le=4096)]],
    Field(min_length=1, max_length=20, description="the sizes, up to 4096, of 1 to 20 layers, such as [256,256]"),
]


NOT_THERE = "not_there"  # type of the error for what this machine does not have: a file, a folder, a device


def not_there(problem: str) -> PydanticCustomError:
    """The error of an option that names what this machine does not have.

    The configuration of an existing run may name such things: its files may have been moved, and it may have been
    trained on another machine.
    """
    return PydanticCustomError(NOT_THERE, "{problem}", {"problem": problem})


def why_unavailable(device: str) -> str | None:
    """Why torch cannot use a device on this machine; None if it can."""
    if device == "cpu" or torch.cuda.is_available():
        return None
    return "this machine has no CUDA device that torch can use; choose device=cpu"


def require_available(device: str) -> str:
    """Requires a device that torch can use on this machine.

    Raises:
        PydanticCustomError: if there is none of that name.
    """
    if problem := why_unavailable(device):
        raise not_there(problem)
    return device


DeviceName = Annotated[str, Field(pattern=r"^(cpu|cuda)$", description="cpu or cuda")]
Device = Annotated[DeviceName, AfterValidator(require_available)]
