"""Allowed values of an option in words, from the JSON schema that pydantic derives from its type and bounds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

Schema = Mapping[str, Any]
_TYPES = {"integer": "an integer", "number": "a number", "string": "a text", "object": "a mapping", "array": "a list"}


def allowed(schema: Schema) -> str:
    """Returns the allowed values in words.

    Args:
        schema: JSON schema of one option; its ``description`` comes before words from its type.

    Examples:
        >>> allowed({"type": "integer", "minimum": 1})
        'an integer of at least 1'
        >>> allowed({"anyOf": [{"const": "auto"}, {"type": "number", "exclusiveMinimum": 0}, {"type": "null"}]})
        'auto, a number above 0 or null'
    """
    words = sorted(dict.fromkeys(_alternatives(schema)), key=lambda word: "list" in word)
    return " or ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else words[0]


def names_in(schema: Schema) -> list[str]:
    """Returns the names among the allowed values, also those of a list's elements."""
    found = [name for name in (*schema.get("enum", ()), schema.get("const")) if isinstance(name, str)]
    for part in (*schema.get("anyOf", ()), *([schema["items"]] if isinstance(schema.get("items"), Mapping) else ())):
        found += names_in(part)
    return found


def as_typed(value: object) -> str:
    """Returns a value as it is typed on the command line.

    Examples:
        >>> as_typed([True, None, 1.5, {"a": "b"}])
        '[true,null,1.5,{a: b}]'
    """
    if isinstance(value, bool):
        return str(value).lower()
    if value is None:
        return "null"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {as_typed(one)}" for key, one in value.items()) + "}"
    if isinstance(value, list | tuple):
        return f"[{','.join(map(as_typed, value))}]"
    return str(value)


def _alternatives(schema: Schema) -> Iterator[str]:
    if "description" in schema:
        yield schema["description"]
    elif "anyOf" in schema:
        for part in schema["anyOf"]:
            yield from _alternatives(part)
    elif "enum" in schema:
        yield from map(as_typed, schema["enum"])
    elif "const" in schema:
        yield as_typed(schema["const"])
    elif schema.get("type") == "boolean":
        yield from ("true", "false")
    elif schema.get("type") == "null":
        yield "null"
    elif schema.get("type") == "array" and "items" in schema:
        yield _list(schema)
    else:
        yield _TYPES.get(schema.get("type", ""), "a value") + _bounds(schema)


def _list(schema: Schema) -> str:
    number = "one or more " if schema.get("minItems") else ""
    items = list(_alternatives(schema["items"]))
    like = f", such as {as_typed(schema['examples'][0])}" if "examples" in schema else ""
    if len(items) > 1:
        return f"a list out of {', '.join(items)}{like}"
    kind, _, bounds = items[0].removeprefix("an ").removeprefix("a ").partition(" ")
    return f"a list of {number}{kind}s {bounds}".rstrip() + like


def _bounds(schema: Schema) -> str:
    if "minimum" in schema and "maximum" in schema:
        return f" from {schema['minimum']} to {schema['maximum']}"
    words = {"minimum": "of at least", "exclusiveMinimum": "above", "maximum": "at most", "exclusiveMaximum": "below"}
    parts = [f"{word} {schema[key]}" for key, word in words.items() if key in schema]
    return f" {' and '.join(parts)}" if parts else ""
