"""Writes files so that a full disk or a kill leaves the earlier one: under a temporary name, renamed when complete."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

DAY = 86_400.0  # s; a temporary file that was last written longer ago was left by a killed process


def partial_name(path: Path) -> Path:
    """Returns an unused temporary name beside a file or folder.

    The suffix stays the same, because some writers choose the format by it. Temporary files in that folder that killed
    processes left more than a day ago are removed.
    """
    remove_partial(path.parent, unchanged_for=DAY, below="")
    return path.with_name(f".{path.stem}.{uuid4().hex}.partial{path.suffix}")


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


@contextmanager
def whole_files(folder: str | Path) -> Iterator[Path]:
    """Yields a temporary folder, whose files are moved into ``folder`` when the block succeeds.

    Args:
        folder: created if it does not exist; its other files stay.

    Raises:
        OSError: if a file cannot be written.

    Examples:
        >>> import tempfile
        >>> with whole_files(Path(tempfile.mkdtemp()) / "out") as partial:
        ...     _ = (partial / "table.csv").write_text("a,b")
        >>> [file.name for file in (partial.parent).iterdir()]
        ['table.csv']
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    partial = partial_name(folder / "files")
    try:
        partial.mkdir()
        yield partial
        # Folders first: on a full disk a folder may fail to be created, and then no file has replaced an earlier one
        for path in sorted(partial.rglob("*"), key=Path.is_file):
            target = folder / path.relative_to(partial)
            if path.is_dir():
                target.mkdir(parents=True, exist_ok=True)
            else:
                os.replace(path, target)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def write_text(path: str | Path, text: str) -> Path:
    """Writes a text file in UTF-8, see :func:`whole_file`, and returns its path."""
    with whole_file(path) as partial:
        partial.write_text(text, encoding="utf-8")
    return Path(path)


def remove_partial(folder: str | Path, unchanged_for: float = 0.0, below: str = "**/") -> None:
    """Removes temporary files and folders that killed processes have left in a folder and, by default, below it.

    Args:
        folder: the folder. Temporary files that another process is still writing must be younger than
            ``unchanged_for``, or they are removed too.
        unchanged_for: least time since a file was last written, in s.
        below: pattern of the folders below.
    """
    for path in sorted(Path(folder).glob(f"{below}.*.{'[0-9a-f]' * 32}.partial*")):  # all names first: folders change
        if path.exists() and path.stat().st_mtime <= time.time() - unchanged_for:
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)
