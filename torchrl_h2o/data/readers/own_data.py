"""Check that an HDF5 file holds the values of its arrays itself, before they are read.

HDF5 reads values from other files (external links, external raw storage, virtual sources) without a word, and fills
what was never written, or what a virtual source lacks, with zeros.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from torchrl_h2o.data.readers.error import DataError
from torchrl_h2o.data.readers.settings import READER_SETTINGS, ReaderSettings

if TYPE_CHECKING:  # imported where it is used, because the replay buffer does not need it
    import h5py

_REMEDY = "copy all values into one file, for example with h5repack, or write it again"


def require_own_file(path: str | Path, *, settings: ReaderSettings = READER_SETTINGS) -> None:
    """Raise DataError unless all arrays of an HDF5 file are in this file.

    Args:
        path: the file.
        settings: the largest compression.

    Raises:
        DataError: see :func:`require_own_data`; also for a file that cannot be opened.
    """
    import h5py

    try:
        with h5py.File(path, "r") as file:
            require_own_data(file, list(file), source=path, settings=settings)
    except DataError:
        raise
    except Exception as error:  # h5py raises errors of all kinds for damaged files
        raise DataError(
            f"the file cannot be read as HDF5: {error}",
            "the file is truncated or of another format: copy or download it again",
            source=path,
        ) from error


def require_own_data(
    group: h5py.Group, names: Iterable[str], *, source: str | Path, settings: ReaderSettings = READER_SETTINGS
) -> None:
    """Raise DataError unless the named arrays, and all arrays in named groups, are in the file itself.

    Args:
        group: an open file or group.
        names: the entries to check.
        source: the file, for errors.
        settings: the largest compression.

    Raises:
        DataError: for an external or soft link, external raw storage, a virtual array with sources in other files or
            without sources, and an array that states many more bytes than the file stores for it.

    Example:
        >>> import h5py, tempfile
        >>> from torchrl_h2o.data.readers.own_data import require_own_data
        >>> path = tempfile.mkdtemp() + "/a.hdf5"
        >>> with h5py.File(path, "w") as file:
        ...     file["rewards"] = h5py.ExternalLink("other.hdf5", "rewards")
        ...     require_own_data(file, ["rewards"], source="a.hdf5")
        Traceback (most recent call last):
        ...
        torchrl_h2o.data.readers.error.DataError: a.hdf5, column 'rewards': it is a link to the file other.hdf5; ...
    """
    import h5py

    for name, entry in _entries(group, names, source):
        if isinstance(entry, h5py.Dataset):
            problem = _elsewhere(entry) or _not_stored(entry, settings)
            if problem is not None:
                raise DataError(problem, _REMEDY, source=source, column=name)


def _entries(group: h5py.Group, names: Iterable[str], source: str | Path) -> Iterator[tuple[str, Any]]:
    """Walk the named entries and all below them, each group once, so that hard links in a circle end."""
    import h5py

    seen: set[int] = set()
    stack = [(name, group, name) for name in reversed(list(names))]
    while stack:
        path, parent, name = stack.pop()
        link = parent.get(name, getlink=True)
        if isinstance(link, h5py.ExternalLink):
            raise DataError(f"it is a link to the file {link.filename}", _REMEDY, source=source, column=path)
        if isinstance(link, h5py.SoftLink):
            raise DataError(f"it is a link to {link.path}", _REMEDY, source=source, column=path)
        entry = parent[name]
        if isinstance(entry, h5py.Group):
            address = cast("Any", h5py).h5o.get_info(entry.id).addr
            if address in seen:
                continue
            seen.add(address)
            stack += [(f"{path}/{inner}", entry, inner) for inner in reversed(list(entry))]
        yield path, entry


def _elsewhere(dataset: h5py.Dataset) -> str | None:
    if dataset.external:
        return f"its values are in the file {dataset.external[0][0]}"
    if not dataset.is_virtual:
        return None
    sources = dataset.virtual_sources()
    other = next((part for part in sources if part.file_name != "."), None)
    if other is not None:
        missing = "" if (Path(dataset.file.filename).parent / other.file_name).exists() else ", which is missing"
        return f"its values are in the file {other.file_name}{missing}"
    missing = next((part.dset_name for part in sources if part.dset_name not in dataset.file), None)
    if missing is not None:
        return f"its values are in the array {missing}, which is missing"
    return None


def _not_stored(dataset: h5py.Dataset, settings: ReaderSettings) -> str | None:
    if dataset.is_virtual or dataset.shape is None:
        return None
    stated, stored = int(dataset.nbytes), cast("int", dataset.id.get_storage_size())
    compressed = dataset.id.get_create_plist().get_nfilters() > 0
    if stated <= stored * (settings.largest_compression if compressed else 1):
        return None
    return f"it states {stated} bytes {list(dataset.shape)}, but the file stores {stored} bytes of it"
