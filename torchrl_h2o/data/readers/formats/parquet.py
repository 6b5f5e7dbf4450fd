"""Read the columns of a Parquet file."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchrl_h2o.data.readers.error import DataError
from torchrl_h2o.data.readers.formats.raw_table import RawTable, require_package, require_plausible_size, table_of

if TYPE_CHECKING:
    from torchrl_h2o.data.readers.log_columns import LogColumns


def read_parquet(path: Path, layout: LogColumns | None) -> RawTable:
    """Read a Parquet file with pyarrow; a missing value becomes NaN, which a layout refuses.

    Raises:
        DataError: for a damaged file, fewer than two rows, or sizes far beyond the file's own.
    """
    require_package("pyarrow", path)
    import pyarrow
    from pyarrow import parquet

    try:
        file = parquet.ParquetFile(path)
    except (pyarrow.ArrowException, OSError) as error:
        problem = f"the file cannot be read as Parquet: {error}"
        raise DataError(problem, "copy or write it again", source=path) from error
    with file:
        rows, names = file.metadata.num_rows, file.schema_arrow.names
    if rows < 2:
        raise DataError(f"there are {rows} rows of data", "a transition needs two", source=path)
    require_plausible_size(8 * rows * len(names), path)

    def values(name: str) -> np.ndarray:
        try:
            return parquet.read_table(path, columns=[name]).column(0).to_numpy()
        except (pyarrow.ArrowException, OSError) as error:
            problem = f"the column cannot be read: {error}"
            raise DataError(problem, "copy or write the file again", source=path, column=name) from error

    return table_of({name: partial(values, name) for name in names}, rows, path, layout)
