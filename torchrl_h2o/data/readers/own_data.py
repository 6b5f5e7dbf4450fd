"""Find the arrays of an HDF5 file and check that the file itself holds their values, before they are read.

HDF5 reads values from other files (external links, external raw storage, virtual sources) without a word, and fills
what was never written, or what a virtual source lacks, with zeros.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from torchrl_h2o.data.readers.error import DataError
from torchrl_h2o.data.readers.file_kind import require_plausible_size

if TYPE_CHECKING:  # imported where it is used, because the replay buffer does not need it
    import h5py

_REMEDY = "copy all values into one file, for example with h5repack, or write it again"
LARGEST_COMPRESSION = 1100.0  # bytes that an array states by those that its file stores; deflate reaches 1032


def own_arrays(group: h5py.Group, names: Iterable[str], *, source: str | Path) -> dict[str, h5py.Dataset]:
    """Return the named arrays of a file, and all arrays in named groups, by their paths.

    Args:
        group: an open file or group.
        names: the entries.
        source: the file.

    Raises:
        DataError: for an external or soft link, two hard links to one entry, which may form a circle, external raw
            storage, a virtual array with sources in other files or without sources, and an array that states many more
            bytes than the file stores for it.

    Example:
        >>> import h5py, tempfile
        >>> from torchrl_h2o.data.readers.own_data import own_arrays
        >>> path = tempfile.mkdtemp() + "/a.hdf5"
        >>> with h5py.File(path, "w") as file:
        ...     file["rewards"] = h5py.ExternalLink("other.hdf5", "rewards")
        ...     own_arrays(file, ["rewards"], source="a.hdf5")
        Traceback (most recent call last):
        ...
        torchrl_h2o.data.readers.error.DataError: a.hdf5, column 'rewards': it is a link to the file other.hdf5; ...
    """
    import h5py

    found = {name: entry for name, entry in _entries(group, names, source) if isinstance(entry, h5py.Dataset)}
    for name, dataset in found.items():
        problem = _elsewhere(dataset) or _not_stored(dataset)
        if problem is not None:
            raise DataError(problem, _REMEDY, source=source, column=name)
    require_plausible_size(sum(int(dataset.nbytes) for dataset in found.values()), Path(group.file.filename))
    return found


def _entries(group: h5py.Group, names: Iterable[str], source: str | Path) -> Iterator[tuple[str, Any]]:
    """Walk the named entries and all below them."""
    import h5py

    first: dict[int, str] = {}
    stack = [(name, group, name) for name in reversed(list(names))]
    while stack:
        path, parent, name = stack.pop()
        link = parent.get(name, getlink=True)
        if isinstance(link, h5py.ExternalLink | h5py.SoftLink):
            target = f"the file {link.filename}" if isinstance(link, h5py.ExternalLink) else link.path
            raise DataError(f"it is a link to {target}", _REMEDY, source=source, column=path)
        entry = parent[name]
        address = cast("Any", h5py).h5o.get_info(entry.id).addr
        if first.setdefault(address, path) != path:
            raise DataError(f"it is another link to {first[address]}", _REMEDY, source=source, column=path)
        if isinstance(entry, h5py.Group):
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
    return None if missing is None else f"its values are in the array {missing}, which is missing"


def _not_stored(dataset: h5py.Dataset) -> str | None:
    if dataset.is_virtual or dataset.shape is None:
        return None
    stated, stored = int(dataset.nbytes), cast("int", dataset.id.get_storage_size())
    compressed = dataset.id.get_create_plist().get_nfilters() > 0
    if stated <= stored * (LARGEST_COMPRESSION if compressed else 1):
        return None
    return f"it states {stated} bytes {list(dataset.shape)}, but the file stores {stored} bytes of it"
