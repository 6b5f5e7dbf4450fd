"""Stored records of finished runs: what was run, what produced it, and the values found, one small JSON file each.

Benchmarks write them; ``recipes/results/make.py`` stores them, and those of trainings and reports, and makes its tables
of them.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from torchrl_h2o.provenance import provenance
from torchrl_h2o.whole_file import write_text


@dataclass(frozen=True)
class Record:
    """What one run found.

    Args:
        table: the table whose row it is.
        name: names the run within the table, and its file.
        made_by: commit, versions, CPU seconds and processor, see :func:`~torchrl_h2o.provenance.provenance`.
        values: what was run and what was found, as JSON values.
    """

    table: str
    name: str
    made_by: Mapping[str, Any]
    values: Mapping[str, Any]

    @classmethod
    def of_this_process(cls, table: str, name: str, values: Mapping[str, Any], since: float = 0.0) -> Record:
        """Build the record of a run that ends now; ``since`` is :func:`~torchrl_h2o.provenance.cpu_seconds` before."""
        return cls(table, name, provenance(since), values)

    def save(self, folder: Path) -> Path:
        """Write ``folder/TABLE/NAME.json`` without folders of the machine, and return its path."""
        path = folder / self.table / f"{self.name}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        text = json.dumps(_portable(asdict(self)), indent=1, default=float, ensure_ascii=False)
        write_text(path, text + "\n")
        return path

    @property
    def is_current(self) -> bool:
        """Whether the code that runs now made it, and no file of that code differs from its commit."""
        now = provenance()
        return bool(now["commit"]) and self.made_by["commit"] == now["commit"] and not (now["dirty"] or self.is_dirty)

    @property
    def is_dirty(self) -> bool:
        """Whether it is not known to be of the code of its commit."""
        return self.made_by.get("dirty") is not False


def read_records(folder: Path, table: str = "*") -> Iterator[Record]:
    """Read the records below a folder, of one table or of all, in the order of their names; other files are ignored."""
    names = {field.name for field in fields(Record)}
    for path in sorted(folder.glob(f"{table}/*.json")):
        if (entries := json.loads(path.read_text())).keys() == names:
            yield Record(**entries)


def shorten_paths(text: str) -> str:
    """Shorten each absolute path in a text to its last two parts, because its folder exists on one machine only.

    Example:
        >>> shorten_paths("data=[/home/me/logs/a.txt,b.txt]"), shorten_paths("N·m/rad and/or m/s")
        ('data=[logs/a.txt,b.txt]', 'N·m/rad and/or m/s')
    """
    return re.sub(r"(?<![\w.:/·²³⁻)])/[^\s,;\])'\"]*", lambda path: "/".join(Path(path[0]).parts[1:][-2:]), text)


def _portable(value: Any) -> Any:
    if isinstance(value, str):
        return shorten_paths(value)
    if isinstance(value, Mapping):
        return {key: _portable(entry) for key, entry in value.items()}
    return [_portable(entry) for entry in value] if isinstance(value, list | tuple) else value
