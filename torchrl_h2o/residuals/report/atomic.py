"""Writes a text file so that a full disk or a kill leaves the earlier one."""

from __future__ import annotations

import os
from pathlib import Path


def write_text(path: str | Path, text: str) -> Path:
    """Writes a text file under a temporary name in the same folder and renames it when it is complete.

    Args:
        path: the file; its folder is created if it does not exist.
        text: the contents, written in UTF-8.

    Returns:
        The path.

    Raises:
        OSError: if the file cannot be written; an existing one is unchanged.

    Examples:
        >>> import tempfile
        >>> path = write_text(Path(tempfile.mkdtemp()) / "report.json", "{}")
        >>> path.read_text(), [file.name for file in path.parent.iterdir()]
        ('{}', ['report.json'])
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with open(partial, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())  # otherwise a power cut may leave an empty file under the final name
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
    return path
