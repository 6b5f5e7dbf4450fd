"""File formats of logs: each reader returns a :class:`RawTable`, whose columns a layout then selects and converts."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from torchrl_h2o.data.readers.error import DataError
from torchrl_h2o.data.readers.file_kind import require_file
from torchrl_h2o.data.readers.formats.arrays import read_mat, read_npz, read_pt
from torchrl_h2o.data.readers.formats.lerobot import is_lerobot, read_lerobot
from torchrl_h2o.data.readers.formats.mcap_bag import read_mcap
from torchrl_h2o.data.readers.formats.parquet import read_parquet
from torchrl_h2o.data.readers.formats.raw_table import RawTable
from torchrl_h2o.data.readers.formats.split_log import SplitLog, read_split
from torchrl_h2o.data.readers.formats.text import read_text

if TYPE_CHECKING:
    from torchrl_h2o.data.readers.log_columns import LogColumns

_TEXT = dict.fromkeys((".csv", ".txt", ".tsv", ".dat", ".log"), read_text)
FORMATS = {
    **_TEXT,
    ".npz": read_npz,
    ".mat": read_mat,
    ".pt": read_pt,
    ".pth": read_pt,
    ".parquet": read_parquet,
    ".mcap": read_mcap,
}
"""Reader of a file by its suffix; a file with any other suffix is read as text."""


def read_raw(path: str | PathLike[str], layout: LogColumns | None = None) -> RawTable:
    """Read the columns of a log before they are selected and converted.

    Args:
        path: the log, the folder of a LeRobot dataset, or several files of one run.
        layout: the columns, which must be those of the file, with separator, header, comment and decimal of a text
            file and the topic of a bag. A file that names its columns can be read without it.

    Returns:
        All columns of the file; the values of most formats are read when they are asked for.

    Raises:
        DataError: for a file that is missing, damaged or of another format.

    Example:
        >>> import numpy as np, tempfile
        >>> from torchrl_h2o.data.readers.formats import read_raw
        >>> path = tempfile.mkdtemp() + "/run.npz"
        >>> np.savez(path, q=np.zeros((5, 2)), u=np.ones(5))
        >>> read_raw(path).names
        ('q[0]', 'q[1]', 'u')
    """
    if isinstance(path, SplitLog):
        if layout is None:
            problem = "files of one run do not describe their columns"
            raise DataError(problem, "give a column description", source=path)
        return read_split(path, layout, read_raw)
    if is_lerobot(path):
        return read_lerobot(Path(path).expanduser(), layout)
    path = require_file(Path(path))
    return FORMATS.get(path.suffix.lower(), read_text)(path, layout)
