"""Write a folder atomically: under a temporary name first, then rename it when it is complete."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from torchrl_h2o.data.readers.error import DataError
from torchrl_h2o.whole_file import partial_name


@contextmanager
def whole_folder(folder: str | Path, *, replace: bool = False) -> Iterator[Path]:
    """Yield a temporary folder next to ``folder`` that is renamed to it when the block succeeds.

    If the block raises or the process is killed, ``folder`` is not created. Its temporary name is that of
    :mod:`torchrl_h2o.whole_file`, which also removes it after a kill.

    Args:
        folder: the final name.
        replace: whether to replace an existing folder of that name, at the end of the block.

    Raises:
        DataError: if the folder exists and ``replace`` is false, another process has made it in the meantime, or it
            cannot be made, as in a folder that is read-only.

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
    _require_absent(folder, replace)
    try:
        partial = partial_name(folder)  # of this process, because several may make the same folder at once
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
    except OSError as error:
        problem = f"the folder cannot be made: {error.strerror or error}"
        raise DataError(problem, "choose another place", source=folder) from error
    try:
        yield partial
        _require_absent(folder, replace)
        if folder.exists():  # a folder cannot be renamed onto a folder with files
            replaced = folder.with_name(f".{folder.name}.replaced")
            shutil.rmtree(replaced, ignore_errors=True)
            folder.rename(replaced)
            partial.rename(folder)
            shutil.rmtree(replaced)
        else:
            partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _require_absent(folder: Path, replace: bool) -> None:
    if folder.exists() and not replace:
        raise DataError("the folder exists and is never overwritten", "remove it or choose another name", source=folder)
