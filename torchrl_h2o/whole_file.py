"""Writes files so that a full disk or a kill leaves the earlier one: under a temporary name, renamed when complete.

The temporary name contains the machine and the number of the process, so that what a killed process has left can be
told from what another one is writing, also in a folder that several machines share.
"""

from __future__ import annotations

import os
import platform
import re
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from glob import escape
from pathlib import Path

_PARTIAL = re.compile(r"\..+\.([\w-]+)-(\d+)\.partial(\.\w+)?")
MACHINE = re.sub(r"[^\w-]", "_", platform.node()) or "machine"


def partial_name(path: Path) -> Path:
    """The temporary name of a file or folder, of which killed processes have left nothing.

    It keeps the suffix, because some writers choose the format by it.
    """
    before, after = f".{path.stem}.", f".partial{path.suffix}"
    _remove_left(path.parent.glob(f"{escape(before)}*{escape(after)}"))
    return path.with_name(f"{before}{MACHINE}-{os.getpid()}{after}")


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """Yields a temporary name in the same folder, which is renamed to ``path`` when the block succeeds.

    Args:
        path: the file; its folder is created if it does not exist.

    Raises:
        OSError: if the file cannot be written; an existing one is unchanged.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "table.csv"
        >>> with whole_file(path) as partial:
        ...     _ = partial.write_text("a,b")
        ...     assert not path.exists()
        >>> path.read_text(), [file.name for file in path.parent.iterdir()]
        ('a,b', ['table.csv'])
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = partial_name(path)
    try:
        yield partial
        with open(partial, "r+b") as file:
            os.fsync(file.fileno())  # otherwise a power cut may leave an empty file under the final name
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> Path:
    """Writes a text file in UTF-8, see :func:`whole_file`, and returns its path.

    Examples:
        >>> import tempfile
        >>> write_text(Path(tempfile.mkdtemp()) / "report.json", "{}").read_text()
        '{}'
    """
    path = Path(path)
    with whole_file(path) as partial:
        partial.write_text(text, encoding="utf-8")
    return path


def remove_partial(folder: str | Path) -> None:
    """Removes temporary files and folders that killed processes have left in a folder and below it.

    Those of processes that run, and those of other machines, are left alone.

    Args:
        folder: the folder.
    """
    _remove_left(Path(folder).rglob(".*.partial*"))


def _remove_left(paths: Iterable[Path]) -> None:
    for path in sorted(paths):  # first all names, because the folders change
        named = _PARTIAL.fullmatch(path.name)
        if named is None or named[1] != MACHINE or _runs(int(named[2])):
            continue
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _runs(process: int) -> bool:
    """Whether there is a process of this number on this machine."""
    try:
        os.kill(process, 0)  # sends nothing
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # it belongs to another user, or the number is none
        return True
    return True
