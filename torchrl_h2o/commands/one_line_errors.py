"""Ends a program with one line for errors that the package raises on purpose, or Hydra for a wrong configuration."""

from __future__ import annotations

import dis
import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

FULL_ERROR = "HYDRA_FULL_ERROR"
_OF_THE_DISK = {errno.EACCES, errno.EDQUOT, errno.EFBIG, errno.ENOSPC, errno.EPERM, errno.EROFS}
_RAISE = dis.opmap["RAISE_VARARGS"]  # the bytecode of a raise statement
_PACKAGE = Path(__file__).resolve().parents[1]
_OWN_FOLDERS = (_PACKAGE, _PACKAGE.with_name("recipes"))


@contextmanager
def one_line_errors() -> Iterator[None]:
    """Prints an expected error as ``<class>: <message>`` on the standard error and exits with status 1.

    With HYDRA_FULL_ERROR=1, and for all other exceptions, nothing changes.

    Raises:
        SystemExit: instead of an expected error.

    Examples:
        >>> from torchrl_h2o.data import DataError
        >>> with one_line_errors():
        ...     raise DataError("no such column", "choose another", source="log.csv", column="v")
        Traceback (most recent call last):
        ...
        SystemExit: 1
    """
    full = asks_for_tracebacks()
    try:
        yield
    except Exception as error:
        if full or not is_expected(error):
            raise
        message, _, _ = str(error).partition("Config search path:")  # Hydra's list of places inside the package
        remedy = "; make room, or choose a folder that can be written" if of_the_disk(error) else ""
        sys.stderr.write(f"{type(error).__name__}: {' '.join(message.split())}{remedy}\n")
        sys.exit(1)


def asks_for_tracebacks() -> bool:
    """Whether the user has set HYDRA_FULL_ERROR=1."""
    return os.environ.get(FULL_ERROR) == "1"


def is_expected(error: Exception) -> bool:
    """Whether an error tells the user what to correct, rather than the developer.

    These are Hydra's errors of the configuration, DataError, an OSError of a disk that is full or may not be written,
    and ValueError, OSError and ArithmeticError (a training that diverges) if a ``raise`` statement of this package or
    of its recipes raised them. A ValueError that NumPy raises is a bug.
    """
    from torchrl_h2o.data import DataError

    if isinstance(error, HydraException | OmegaConfBaseException | DataError) or of_the_disk(error):
        return True
    return isinstance(error, ValueError | OSError | ArithmeticError) and _is_raised_here(error)


def of_the_disk(error: Exception) -> bool:
    """Whether an error says that a disk is full, or that a file or folder may not be written."""
    return isinstance(error, OSError) and error.errno in _OF_THE_DISK


def _is_raised_here(error: Exception) -> bool:
    trace = error.__traceback__
    if trace is None:
        return False
    while trace.tb_next is not None:
        trace = trace.tb_next
    code = trace.tb_frame.f_code
    own = any(Path(code.co_filename).resolve().is_relative_to(folder) for folder in _OWN_FOLDERS)
    return own and code.co_code[trace.tb_lasti] == _RAISE
