"""Write a folder all or nothing: under another name first, renamed when it is complete."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from torchrl_h2o.data.readers.error import DataError


@contextmanager
def whole_folder(folder: str | Path, *, replace: bool = False) -> Iterator[Path]:
    """Give a temporary folder beside ``folder`` that takes its name when the block ends well.

    A block that raises, or a process that is killed, leaves nothing under ``folder``.

    Args:
        folder: the final name.
        replace: let an older folder of that name make way, at the last moment.

    Raises:
        DataError: it exists and is not to be replaced.

    Example:
        >>> import pathlib, tempfile
        >>> target = pathlib.Path(tempfile.mkdtemp()) / "run"
        >>> with whole_folder(target) as partial:
        ...     _ = (partial / "a.txt").write_text("a")
        ...     assert not target.exists()
        >>> (target / "a.txt").read_text()
        'a'
    """
    folder = Path(folder).expanduser()
    if folder.exists() and not replace:
        raise DataError("it exists and is never overwritten", "remove it or take another name", source=folder)
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)  # what a killed process has left
    partial.mkdir(parents=True)
    try:
        yield partial
        if folder.exists():  # a folder can only be renamed onto an empty one
            replaced = folder.with_name(f".{folder.name}.replaced")
            shutil.rmtree(replaced, ignore_errors=True)
            folder.rename(replaced)
            partial.rename(folder)
            shutil.rmtree(replaced)
        else:
            partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
