"""Read the arrays of NumPy's .npz and MATLAB's .mat files as columns: ``q`` of shape (T, 2) is q[0] and q[1].

Arrays whose length is not that of the longest array, such as a scalar dt, are not columns.
"""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_h2o.data.readers.error import DataError
from torchrl_h2o.data.readers.formats.raw_table import RawTable, require_package, require_plausible_size, table_of
from torchrl_h2o.data.readers.own_data import require_own_data

if TYPE_CHECKING:
    from torchrl_h2o.data.readers.log_columns import LogColumns

_HDF5_START = b"\x89HDF\r\n\x1a\n"
_HEADER = 512  # bytes before the HDF5 part of a MATLAB 7.3 file


def read_npz(path: Path, layout: LogColumns | None) -> RawTable:
    """Read the arrays of an .npz file; objects in them, which are pickles, are refused.

    Raises:
        DataError: for a damaged file, an object array, or an array that states another size than the file stores.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            require_plausible_size(sum(member.file_size for member in archive.infolist()), path)
            for member in archive.infolist():
                _require_stored(archive, member, path)
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except DataError:
        raise
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error, NotImplementedError) as error:
        problem = f"the file cannot be read as .npz: {error}"
        raise DataError(problem, "copy or write it again", source=path) from error
    return _columns(arrays, path, layout)


def read_mat(path: Path, layout: LogColumns | None) -> RawTable:
    """Read the numeric arrays of a MATLAB file, and those in its structures as ``structure.field``.

    Files up to version 7 need scipy; files of version 7.3 are HDF5.

    Raises:
        DataError: for a damaged file, or sizes far beyond the file's own.
    """
    with path.open("rb") as file:
        start = file.read(_HEADER + len(_HDF5_START))
    if _HDF5_START in (start[: len(_HDF5_START)], start[_HEADER:]):
        return _columns(dict(_hdf5_arrays(path)), path, layout)
    require_package("scipy", path)
    from scipy.io import loadmat, whosmat

    try:
        require_plausible_size(sum(8 * math.prod(shape) for _, shape, _ in whosmat(path)), path)
        content = loadmat(path, chars_as_strings=False)
    except DataError:
        raise
    except Exception as error:  # scipy raises errors of all kinds for damaged files
        problem = f"the file cannot be read as .mat: {error}"
        raise DataError(problem, "copy or write it again", source=path) from error
    arrays = {name: values for name, values in content.items() if not name.startswith("__")}
    return _columns(dict(_with_fields(arrays)), path, layout)


def _require_stored(archive: zipfile.ZipFile, member: zipfile.ZipInfo, path: Path) -> None:
    """Raise DataError if the header of an array states another size: numpy would allocate it before it reads."""
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
        stored = member.file_size - file.tell()
    if dtype.hasobject:
        raise DataError(
            "this is a pickle: it holds objects, and reading it could execute arbitrary code",
            "write the array again as numbers",
            source=path,
            column=member.filename.removesuffix(".npy"),
        )
    stated = math.prod(shape) * dtype.itemsize
    if stated != stored:
        raise DataError(
            f"it states {stated} bytes {list(shape)}, but the file stores {stored}",
            "the file is damaged: copy or write it again",
            source=path,
            column=member.filename.removesuffix(".npy"),
        )


def _hdf5_arrays(path: Path) -> Iterator[tuple[str, np.ndarray]]:
    import h5py

    try:
        with h5py.File(path, "r") as file:
            names = [name for name in map(str, file) if not name.startswith("#")]
            require_own_data(file, names, source=path)
            stack: list[tuple[str, Any]] = [(name, file[name]) for name in names]
            while stack:
                name, entry = stack.pop(0)
                if isinstance(entry, h5py.Group):
                    stack = [(f"{name}.{inner}", entry[inner]) for inner in entry] + stack
                elif isinstance(entry, h5py.Dataset) and entry.dtype.kind in "fiub":
                    yield name, entry[()].T  # MATLAB stores columns first
    except DataError:
        raise
    except Exception as error:  # h5py raises errors of all kinds for damaged files
        raise DataError(f"the file cannot be read: {error}", "copy or write it again", source=path) from error


def _with_fields(arrays: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Yield numeric arrays, and those in structures of one element, by their path."""
    for name, values in arrays.items():
        if not isinstance(values, np.ndarray):
            continue
        if values.dtype.names is not None and values.size == 1:
            fields = {field: values.flat[0][field] for field in values.dtype.names}
            yield from _with_fields(fields, f"{prefix}{name}.")
        elif values.dtype.kind in "fiubc":
            yield f"{prefix}{name}", values


def _columns(arrays: dict[str, np.ndarray], path: Path, layout: LogColumns | None) -> RawTable:
    known = {name: np.atleast_1d(np.squeeze(values)) for name, values in arrays.items() if values.ndim <= 2}
    length = max((max(values.shape) for values in known.values() if values.size), default=0)
    if length < 2:
        raise DataError(
            f"there are {length} rows of data in {', '.join(arrays) or 'no array'}",
            "a log needs arrays of one or two dimensions, one row per time step",
            source=path,
        )
    columns: dict[str, Callable[[], np.ndarray]] = {}
    for name, values in known.items():
        if length not in values.shape:
            continue
        by_row = values if len(values) == length else values.T
        if by_row.ndim == 1:
            columns[name] = partial(np.asarray, by_row)
        else:
            columns |= {f"{name}[{i}]": partial(np.asarray, by_row[:, i]) for i in range(by_row.shape[1])}
    return table_of(columns, length, path, layout)
