"""Check a file before it is read: reject missing, empty and compressed files, fifos, and pickles.

A pickle can execute code. It is recognised by its name or first bytes and never unpickled.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

from torchrl_h2o.data.readers.error import DataError, unreadable

_PICKLE_SUFFIXES = {".pkl", ".pickle", ".pt", ".pth", ".npy", ".npz", ".joblib", ".ckpt"}
# pickles from protocol 2 on start with the opcode PROTO; torch.save and .npz are zip files; .npy may contain objects
_PICKLE_STARTS = (b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05", b"PK\x03\x04", b"\x93NUMPY")
_GZIP_START = b"\x1f\x8b"
_TORCH_SUFFIXES = {".pt", ".pth"}
LARGEST_EXPANSION = 200.0  # bytes of the values by those of their compressed file
UNSUSPICIOUS_BYTES = 2**26  # values of this size are read whatever their compression


def is_pickle(path: str | Path) -> bool:
    """Return whether a file is a pickle or may contain one, by its name and first bytes.

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
    if path.suffix.lower() == ".npz" and path.is_file() and zipfile.is_zipfile(path):
        # objects in the arrays are refused where the arrays are read
        try:
            with zipfile.ZipFile(path) as archive:
                return not all(name.endswith(".npy") for name in archive.namelist())
        except (zipfile.BadZipFile, NotImplementedError, ValueError, OSError):
            return False  # read_npz says what is wrong with the archive
    if path.suffix.lower() in _PICKLE_SUFFIXES:
        return True
    with path.open("rb") as file:
        return file.read(8).startswith(_PICKLE_STARTS)


def require_file(path: str | Path) -> Path:
    """Return the path of a file after checking that it exists, is not empty and is not a pickle.

    Args:
        path: a file.

    Raises:
        DataError: for a missing file, a folder, a fifo or device, an empty or compressed file, a pickle, or a file that
            may not be read.
    """
    path = Path(path).expanduser()
    if not path.exists():
        raise DataError("there is no such file", "check the path", source=path)
    if path.is_dir():
        raise DataError("this is a folder, but a file was expected", "give the file in it", source=path)
    if not path.is_file():  # opening a fifo would wait for a writer, reading /dev/zero would not end
        raise DataError("this is not a regular file", "copy the data into a file and give that", source=path)
    with unreadable("the file cannot be opened", "check its permissions", source=path), path.open("rb") as file:
        start = file.read(len(_GZIP_START))
    if is_pickle(path) and path.suffix.lower() not in _TORCH_SUFFIXES:  # of which torch reads the tensors alone
        raise DataError(
            "this is a pickle, or a format that may contain one, and reading it could execute arbitrary code",
            "if you trust the file, convert it to CSV, HDF5 or a memory-mapped TensorDict",
            source=path,
        )
    if not start:
        raise DataError("the file is empty", "copy or record it again", source=path)
    if start == _GZIP_START:
        raise DataError("the file is compressed with gzip", "unpack it with gunzip first", source=path)
    return path


def require_plausible_size(stated: int, path: Path) -> None:
    """Raise DataError if the values would take far more memory than the file has bytes.

    Args:
        stated: bytes of the unpacked values, as the file states them.
        path: the file.
    """
    size = path.stat().st_size
    if stated > max(UNSUSPICIOUS_BYTES, LARGEST_EXPANSION * size):
        raise DataError(
            f"it states {stated} bytes of values, but the file has {size}",
            "if this is right, write the file again without compression",
            source=path,
        )
