"""Read a log's layout from a YAML file, with errors that name the wrong entry.

Three rules of YAML 1.1 need checks: ``on`` means true, ``5e-3`` is a string, and of two equal keys only the last one
counts. Aliases need one as well: nine lines can stand for a billion entries, and an anchor can contain itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from torchrl_h2o.data.readers.error import DataError
from torchrl_h2o.data.readers.log_columns import Column, LogColumns

LARGEST_FILE = 2**20  # bytes of a column description
MOST_ENTRIES = 20_000  # entries of a column description after its aliases are expanded


def read_layout(source: str | Path | Mapping[str, Any]) -> LogColumns:
    """Read a layout; see :meth:`LogColumns.load`."""
    if isinstance(source, Mapping):
        entries, source = dict(source), "columns"
    elif isinstance(source, str | Path):
        entries = _entries_of(source)
    else:
        problem = f"columns={source!r} describes no columns"
        raise DataError(problem, "give LogColumns, the path of a YAML file, or its entries as a mapping")
    known = _known_entries(LogColumns, entries, source)
    if not isinstance(known.get("columns"), list | tuple) or not known["columns"]:
        raise DataError("'columns' is not a list", "list the file's columns", source=source)
    columns = []
    for number, entry in enumerate(known["columns"], start=1):
        named = {"name": f"column {number}", **_known_entries(Column, entry, source)}
        columns.append(_build(Column, named, source, column=str(named["name"])))
    return _build(LogColumns, {**known, "columns": tuple(columns)}, source)


def _entries_of(source: str | Path) -> Any:
    path = _find(source)
    if path.stat().st_size > LARGEST_FILE:
        raise DataError(f"the file has {path.stat().st_size} bytes", "give a column description", source=source)
    try:
        return yaml.load(path.read_text(encoding="utf-8"), _Loader)
    except RecursionError as error:
        raise DataError("the entries are nested too deeply", "correct the file", source=source) from error
    except yaml.constructor.ConstructorError as error:
        line = None if error.problem_mark is None else error.problem_mark.line + 1
        raise DataError(str(error.problem), "correct the column description", source=source, row=line) from error
    except (yaml.YAMLError, ValueError) as error:  # ValueError: not UTF-8, no such day, a number of 5,000 digits
        raise DataError(f"invalid YAML: {error}", "correct the file", source=source) from error


class _Loader(yaml.SafeLoader):
    """yaml's safe loader, which additionally rejects duplicate keys, and aliases that expand without measure."""

    def get_single_node(self):
        node = super().get_single_node()
        if node is not None:
            _expanded_size(node, {})
        return node

    def construct_mapping(self, node, deep=False):
        seen = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                continue
            if key.value in seen:
                problem = f"duplicate entry {key.value!r}"
                raise yaml.constructor.ConstructorError(problem=problem, problem_mark=key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def _expanded_size(node: yaml.Node, sizes: dict[int, int | None]) -> int:
    """Count the entries of a node with its aliases expanded.

    Args:
        node: a node of the graph that yaml makes of a file; an alias is a second edge to the same node.
        sizes: the sizes of nodes by their id; None for a node that is being counted, which thus contains itself.
    """
    if id(node) not in sizes:
        sizes[id(node)] = None
        inner = [part for pair in node.value for part in pair] if isinstance(node, yaml.MappingNode) else node.value
        is_scalar = isinstance(node, yaml.ScalarNode)
        sizes[id(node)] = 1 + (0 if is_scalar else sum(_expanded_size(part, sizes) for part in inner))
    size = sizes[id(node)]
    if size is None or size > MOST_ENTRIES:
        problem = "an anchor contains itself" if size is None else "the aliases expand to too many entries"
        raise yaml.constructor.ConstructorError(problem=problem, problem_mark=node.start_mark)
    return size


def _find(source: str | Path) -> Path:
    path = Path(source).expanduser()
    if path.is_file():
        return path
    if path.exists():
        raise DataError("this is not a regular file", "give a YAML file", source=source)
    shipped = Path(str(resources.files("torchrl_h2o.data.readers") / "logs"))
    names = sorted(file.stem for file in shipped.glob("*.yaml"))
    if str(source) in names:
        return shipped / f"{source}.yaml"
    raise DataError(
        "there is no such column description",
        f"give a YAML file or one of {', '.join(names)}",
        source=source,
    )


def _known_entries(kind: type, entries: Any, source: str | Path) -> dict[str, Any]:
    known = [field.name for field in fields(kind)]
    if not isinstance(entries, dict):
        raise DataError(f"{entries!r} is not a mapping", f"give {', '.join(known)}", source=source)
    for name in entries:
        if name not in known:
            raise DataError(f"unknown entry {name!r}", f"choose from {', '.join(known)}", source=source)
    return entries


def _build(kind: type, entries: dict[str, Any], source: str | Path, column: str | None = None) -> Any:
    try:
        values = {
            name: _CONVERTED[name](name, value) if name in _CONVERTED else value
            for name, value in entries.items()
            if value is not None or name not in _MAY_BE_NULL
        }
        return kind(**values)
    except (ValueError, TypeError) as error:
        raise DataError(str(error), "correct the column description", source=source, column=column) from error


def _number(name: str, value: Any) -> float:
    # YAML 1.1 reads 5e-3 as a string, and on as true, which Python would convert to 1
    if isinstance(value, int | float | str) and not isinstance(value, bool):
        try:
            return float(value)
        except ValueError:
            pass
    raise ValueError(f"{name}: {value!r} is not a number; give the unit in its own entry, and dt in s")


def _pair(name: str, value: Any) -> tuple[float, float]:
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise ValueError(f"{name}: {value!r} must be [lowest, highest]")
    return _number(name, value[0]), _number(name, value[1])


def _names(name: str, value: Any) -> tuple[str, ...]:
    if not isinstance(value, list | tuple) or not all(isinstance(entry, str) for entry in value):
        raise ValueError(f"{name}: {value!r} must be a list of column names; quote on, off and numbers")
    return tuple(value)


_MAY_BE_NULL = ("dt", "resample", "bounds", "observation", "action")
_NUMBERS = ("dt", "resample", "scale", "offset", "time_tolerance")
_CONVERTED = {**dict.fromkeys(_NUMBERS, _number), "bounds": _pair, "observation": _names, "action": _names}
