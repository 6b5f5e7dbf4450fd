"""Read the columns of a Parquet file."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchrl_h2o.data.readers.error import DataError, unreadable
from torchrl_h2o.data.readers.file_kind import require_plausible_size
from torchrl_h2o.data.readers.formats.raw_table import RawTable, columns_of, require_package, table_of

if TYPE_CHECKING:
    from torchrl_h2o.data.readers.log_columns import LogColumns


def read_parquet(path: Path, layout: LogColumns | None) -> RawTable:
    """Read a Parquet file with pyarrow; a missing value becomes NaN, which a layout refuses.

    A column of lists of one length becomes ``name[0]`` and so on.

    Raises:
        DataError: for a damaged file, fewer than two rows, or sizes far beyond the file's own.
    """
    require_package("pyarrow", path)
    import pyarrow
    from pyarrow import parquet

    with unreadable("the file cannot be read as Parquet", source=path), parquet.ParquetFile(path) as file:
        rows, schema = file.metadata.num_rows, file.schema_arrow
        groups = [file.metadata.row_group(i) for i in range(file.metadata.num_row_groups)]
        count = sum(group.column(i).num_values for group in groups for i in range(group.num_columns))
    if rows < 2:
        raise DataError(f"there are {rows} rows of data", "a transition needs two", source=path)
    require_plausible_size(8 * max(count, rows * len(schema.names)), path)

    def values(name: str) -> np.ndarray:
        with unreadable("the column cannot be read", source=path, column=name):
            return parquet.read_table(path, columns=[name]).column(0).to_numpy()

    columns: dict[str, Callable[[], np.ndarray]] = {}
    for name, kind in zip(schema.names, schema.types, strict=True):
        columns |= {name: partial(values, name)}
        if pyarrow.types.is_list(kind) or pyarrow.types.is_fixed_size_list(kind):
            with suppress(ValueError):  # lists that differ in length are no columns of numbers
                columns |= columns_of(name, np.stack(list(values(name))))
                del columns[name]
    return table_of(columns, rows, path, layout)
