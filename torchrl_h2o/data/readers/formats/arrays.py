"""Read the arrays of NumPy's .npz, MATLAB's .mat and torch's .pt files as columns.

``q`` of shape (T, 2) is q[0] and q[1]. Arrays whose length is not that of the longest array,
such as a scalar dt, are not columns.
"""

from __future__ import annotations

import math
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from torchrl_h2o.data.readers.error import DataError, unreadable
from torchrl_h2o.data.readers.file_kind import require_plausible_size
from torchrl_h2o.data.readers.formats.raw_table import RawTable, columns_of, require_package, table_of
from torchrl_h2o.data.readers.own_data import own_arrays

if TYPE_CHECKING:
    from torchrl_h2o.data.readers.log_columns import LogColumns

_HDF5_START = b"\x89HDF\r\n\x1a\n"
_HEADER = 512  # bytes before the HDF5 part of a MATLAB 7.3 file
_MAT_HEADER, _COMPRESSED = 128, 15  # bytes before the first variable of a MATLAB 5 file; its mark of a compressed one
_VARIABLE_START = 512  # bytes of a variable that hold its name and class


def read_npz(path: Path, layout: LogColumns | None) -> RawTable:
    """Read the arrays of an .npz file; objects in them, which are pickles, are refused.

    Raises:
        DataError: for a damaged or encrypted file, an object array, two arrays of one name, or an array that states
            another size than the file stores.
    """
    arrays: dict[str, np.ndarray] = {}
    with unreadable("the file cannot be read as .npz", source=path), zipfile.ZipFile(path) as archive:
        require_plausible_size(sum(member.file_size for member in archive.infolist()), path)
        for member in archive.infolist():
            name = member.filename.removesuffix(".npy")
            if name in arrays:
                raise DataError("two arrays have this name", "write the file again", source=path, column=name)
            _require_stored(archive, member, name, path)
            with archive.open(member) as file:
                arrays[name] = np.lib.format.read_array(file, allow_pickle=False)
                file.read()  # to the end, where zipfile compares the checksum
    return _columns(arrays, path, layout)


def read_mat(path: Path, layout: LogColumns | None) -> RawTable:
    """Read the numeric arrays of a MATLAB file, and those in its structures as ``structure.field``.

    Files up to version 7 need scipy; files of version 7.3 are HDF5.

    Raises:
        DataError: for a damaged file, sizes far beyond the file's own, or objects such as timeseries.
    """
    with path.open("rb") as file:
        start = file.read(_HEADER + len(_HDF5_START))
    if _HDF5_START in (start[: len(_HDF5_START)], start[_HEADER:]):
        return _columns(_hdf5_arrays(path), path, layout)
    require_package("scipy", path)
    from scipy.io import loadmat, whosmat

    with unreadable("the file cannot be read as .mat", source=path):
        for name, kind in _objects(path):
            raise _object_error(name, kind, path)
        require_plausible_size(sum(8 * math.prod(shape) for _, shape, _ in whosmat(path)), path)
        content = loadmat(path, chars_as_strings=False)
    arrays = {name: values for name, values in content.items() if not name.startswith("__")}
    return _columns(dict(_with_fields(arrays)), path, layout)


def read_pt(path: Path, layout: LogColumns | None) -> RawTable:
    """Read the tensors that ``torch.save`` wrote in a dictionary by name, and those in dictionaries in it as ``a.b``.

    Raises:
        DataError: for a damaged file, or one that holds anything else, whose reading could execute code.
    """
    remedy = "save the tensors by name: torch.save({'time': t, 'position': q, 'target': u}, 'log.pt')"
    with unreadable("it holds more than tensors by name, or is damaged", remedy, source=path):
        content = torch.load(path, map_location="cpu", weights_only=True)
    if not isinstance(content, Mapping):
        raise DataError(f"it holds a {type(content).__name__}, whose columns have no names", remedy, source=path)
    tensors = dict(_tensors(content))
    require_plausible_size(sum(8 * values.numel() for values in tensors.values()), path)
    with unreadable("it holds tensors that are no plain numbers", remedy, source=path):
        arrays = {name: values.detach().to(torch.float64).numpy() for name, values in tensors.items()}
    return _columns(arrays, path, layout)


def _tensors(content: Mapping[Any, Any], prefix: str = "") -> Iterator[tuple[str, torch.Tensor]]:
    """Yield tensors, and those in dictionaries, by their path."""
    for name, value in content.items():
        if isinstance(value, Mapping):
            yield from _tensors(value, f"{prefix}{name}.")
        elif isinstance(value, torch.Tensor):
            yield f"{prefix}{name}", value


def _require_stored(archive: zipfile.ZipFile, member: zipfile.ZipInfo, name: str, path: Path) -> None:
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
            column=name,
        )
    stated = math.prod(shape) * dtype.itemsize
    if stated != stored:
        raise DataError(
            f"it states {stated} bytes {list(shape)}, but the file stores {stored}",
            "the file is damaged: copy or export it again",
            source=path,
            column=name,
        )


def _hdf5_arrays(path: Path) -> dict[str, np.ndarray]:
    import h5py

    with unreadable("the file cannot be read", source=path), h5py.File(path, "r") as file:
        names = [name for name in map(str, file) if not name.startswith("#")]
        found = {name.replace("/", "."): each for name, each in own_arrays(file, names, source=path).items()}
        for name, each in found.items():
            if "MATLAB_object_decode" in each.attrs:
                raise _object_error(name, np.bytes_(each.attrs["MATLAB_class"]).decode(errors="replace"), path)
        # MATLAB stores columns first
        return {name: each[()].T for name, each in found.items() if each.dtype.kind in "fiub"}


def _objects(path: Path) -> Iterator[tuple[str, str]]:
    """Yield name and class of each variable of a MATLAB 5 file that is an object, of which scipy reads no values."""
    content, place = path.read_bytes(), _MAT_HEADER
    while place + 8 <= len(content):
        kind, size = struct.unpack_from("<II", content, place)
        start = content[place + 8 : place + 8 + size]
        if kind == _COMPRESSED:
            start = zlib.decompressobj().decompress(start, _VARIABLE_START)
        named = re.search(rb"(\w+)\W+MCOS\W+(\w+)", start[:_VARIABLE_START])
        if named is not None:
            yield named[1].decode(errors="replace"), named[2].decode(errors="replace")
        place += 8 + size


def _object_error(name: str, kind: str, path: Path) -> DataError:
    return DataError(
        f"it is a {kind}, a MATLAB object whose values only MATLAB can read",
        f"save its arrays: t = {name}.Time; x = {name}.Data; save('log.mat', 't', 'x')",
        source=path,
        column=name,
    )


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
        if length in values.shape:
            columns |= columns_of(name, values if len(values) == length else values.T)
    return table_of(columns, length, path, layout)
