"""Checks a command's configuration against its model, and says in one line what is wrong and what is allowed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationToMissingValueError
from pydantic import ValidationError
from pydantic_core import ErrorDetails

from torchrl_h2o.options.nearest import did_you_mean
from torchrl_h2o.options.types import NOT_THERE, Options
from torchrl_h2o.options.words import Schema, allowed, as_typed, names_in

MISSING, UNKNOWN = "missing", "extra_forbidden"  # pydantic's types of errors
LISTED = "; --help lists the options"
SAID = ("value_error", NOT_THERE)  # errors of our own validators, with our own words


def check_options(cfg: DictConfig, model: type[Options], *, saved: bool = False) -> None:
    """Checks the options of a command before it begins its work.

    Args:
        cfg: the command's configuration; entries that are ``???`` count as not given.
        model: the options with their types and bounds.
        saved: whether this is the configuration of an existing run. Another recipe with further options may have
            written it, its files may have been moved since, and it may name a device that this machine does not have.

    Raises:
        ValueError: in one line, for each wrong option: its value, what is allowed, and the most similar name.

    Examples:
        >>> from pydantic import create_model
        >>> from torchrl_h2o.options.types import Count, Share
        >>> Small = create_model("Small", __base__=Options, gamma=Share, updates=Count)
        >>> check_options(OmegaConf.create({"gamma": 0.99, "updates": 100}), Small)
        >>> check_options(OmegaConf.create({"gamma": 1.5, "updates": 100}), Small)
        Traceback (most recent call last):
        ...
        ValueError: gamma=1.5: must be a number from 0 to 1
    """
    values = _given(cfg)
    try:
        model.model_validate(values)
    except ValidationError as error:
        accepted = frozenset({UNKNOWN, NOT_THERE} if saved else ())
        errors = error.errors(include_url=False)
        problems = _problems(errors, accepted, _schema_of(model), cast("Mapping[str, Any]", values))
        if problems:
            raise ValueError("; ".join(problems)) from None


@cache
def _schema_of(model: type[Options]) -> Schema:
    return model.model_json_schema()


def _given(cfg: DictConfig) -> Any:
    """The entries that have a value."""
    try:
        values = OmegaConf.to_container(cfg, resolve=True)
    except InterpolationToMissingValueError:
        values = OmegaConf.to_container(cfg)
    return _without_missing(values)


def _without_missing(value: Any) -> Any:
    if isinstance(value, dict):  # OmegaConf writes ??? for an entry that must be given and is not
        return {key: _without_missing(one) for key, one in value.items() if one != "???"}
    return value


def _problems(
    errors: Sequence[ErrorDetails], accepted: frozenset[str], schema: Schema, values: Mapping[str, Any]
) -> list[str]:
    """One problem for each wrong option, although a type with alternatives has one error for each of them."""
    by_option: dict[tuple[int | str, ...], list[ErrorDetails]] = {}
    for error in errors:
        option = error["loc"] if error["type"] == UNKNOWN else _located(error["loc"], schema)[0]
        by_option.setdefault(option, []).append(error)
    return [
        _problem(min(group, key=lambda error: error["type"] not in SAID), schema, values)
        for group in by_option.values()
        if not accepted & {error["type"] for error in group}
    ]


def _problem(error: ErrorDetails, schema: Schema, values: Mapping[str, Any]) -> str:
    path, own = _located(error["loc"], schema)
    if error["type"] == UNKNOWN:
        *folder, unknown = map(str, error["loc"])
        return f"no option {'.'.join([*folder, unknown])}{did_you_mean(unknown, _entries(own, schema)) or LISTED}"
    name = ".".join(path)
    if error["type"] == MISSING:
        return f"{name} is missing: write {name}=..., {allowed(own)}"
    said = str(error.get("ctx", {}).get("error", error["msg"]))
    if error["type"] in SAID and (not path or _entries(own, schema)):
        return said  # of several options together
    value: Any = values
    for part in path:
        value = value[part]
    if error["type"] in SAID:
        one = "" if error["input"] == value else f"{as_typed(error['input'])}: "
        return f"{name}={as_typed(value)}: {one}{said}"
    return f"{name}={as_typed(value)}: must be {allowed(own)}{did_you_mean(error['input'], names_in(own))}"


def _located(place: Sequence[int | str], schema: Schema) -> tuple[tuple[str, ...], Schema]:
    """The option that an error's place belongs to, as a path, and the schema of this option."""
    path: tuple[str, ...] = ()
    own: Schema = schema
    for part in place:
        entries = _entries(own, schema)
        if part not in entries:
            break
        path, own = (*path, cast(str, part)), entries[cast(str, part)]
    return path, own


def _entries(own: Schema, schema: Schema) -> Mapping[str, Schema]:
    """The options inside a schema, which may be a reference to another, or null."""
    for part in (own, *own.get("anyOf", ())):
        found = schema["$defs"][part["$ref"].rpartition("/")[2]] if "$ref" in part else part
        if "properties" in found:
            return found["properties"]
    return {}
