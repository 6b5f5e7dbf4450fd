"""Look at a file before it is read: refuse what could run code, what is missing and what is empty.

A pickle is recognised by its name or its first bytes and never opened with an unpickler.
"""

from __future__ import annotations

from pathlib import Path

from torchrl_h2o.data.readers.error import DataError

_PICKLE_SUFFIXES = {".pkl", ".pickle", ".pt", ".pth", ".npy", ".npz", ".joblib", ".ckpt"}
# protocol 2 and later start with PROTO; torch.save and .npz are zip files, .npy may hold objects
_PICKLE_STARTS = (b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05", b"PK\x03\x04", b"\x93NUMPY")
_GZIP_START = b"\x1f\x8b"


def is_pickle(path: str | Path) -> bool:
    """Whether a file is, or may hold, a pickle. It is judged by name and first bytes alone.

    Args:
        path: a file.

    Example:
        >>> import pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "innocent.csv"
        >>> _ = path.write_bytes(b"\\x80\\x04N.")
        >>> is_pickle(path)
        True
    """
    path = Path(path)
    if path.suffix.lower() in _PICKLE_SUFFIXES:
        return True
    with path.open("rb") as file:
        return file.read(8).startswith(_PICKLE_STARTS)


def require_file(path: str | Path) -> Path:
    """Return the path of a file that exists, holds something and is no pickle.

    Args:
        path: a file.

    Raises:
        DataError: a missing file, a folder, an empty or compressed file, a pickle.
    """
    path = Path(path).expanduser()
    if not path.exists():
        raise DataError("there is no such file", "check the path", source=path)
    if path.is_dir():
        raise DataError("this is a folder, a file was expected", "give the file in it", source=path)
    if is_pickle(path):
        raise DataError(
            "this is a pickle, or a format that may hold one, and reading it could run any code",
            "convert it to CSV, HDF5 or a memory-mapped TensorDict where you trust it",
            source=path,
        )
    if path.stat().st_size == 0:
        raise DataError("the file is empty", "copy or record it again", source=path)
    with path.open("rb") as file:
        if file.read(len(_GZIP_START)) == _GZIP_START:
            raise DataError("this is compressed by gzip", "unpack it with gunzip first", source=path)
    return path
