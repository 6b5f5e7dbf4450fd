"""Converts effects to JSON-compatible dictionaries and back."""

import dataclasses
import inspect
import math
from collections.abc import Iterator, Mapping
from typing import Any

from torchrl_h2o.effects.effect import Effect


def effect_to_dict(effect: Effect) -> dict[str, Any]:
    """Converts an effect to a dictionary of numbers, strings and lists.

    Args:
        effect: the effect.

    Returns:
        ``effect``, the name of its class, and its fields by name. Infinity becomes the string ``"inf"``, because JSON
        has no infinity.

    Examples:
        >>> from torchrl_h2o.effects import ActionSaturation, BodyMass
        >>> effect_to_dict(BodyMass(1.2, bodies=("torso", "head")))
        {'effect': 'BodyMass', 'scale': 1.2, 'bodies': ['torso', 'head']}
        >>> effect_to_dict(ActionSaturation())
        {'effect': 'ActionSaturation', 'limit': 'inf', 'actuators': None}
    """
    fields = {field.name: _plain(getattr(effect, field.name)) for field in dataclasses.fields(effect)}
    return {"effect": type(effect).__name__, **fields}


def effect_from_dict(entries: Mapping[str, Any]) -> Effect:
    """Builds the effect of a dictionary that :func:`effect_to_dict` returned.

    An effect class defined outside this package is found once its module has been imported.

    Args:
        entries: ``effect``, the name of the class, and its fields by name; missing fields take their defaults.

    Returns:
        The effect.

    Raises:
        ValueError: for an unknown class, an unknown field or a value that the effect does not allow.

    Examples:
        >>> effect_from_dict({"effect": "BodyMass", "scale": 1.2, "bodies": "torso"})
        BodyMass(scale=1.2, bodies='torso')
        >>> effect_from_dict({"effect": "BodyMas"})  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        ValueError: there is no effect named 'BodyMas'; choose one of ActionBacklash, ActionBias, ...
    """
    classes = {cls.__name__: cls for cls in _below(Effect) if not inspect.isabstract(cls)}
    name = entries.get("effect")
    if name not in classes:
        raise ValueError(f"there is no effect named {name!r}; choose one of {', '.join(sorted(classes))}")
    given = {key: _immutable(value) for key, value in entries.items() if key != "effect"}
    known = [field.name for field in dataclasses.fields(classes[name])]
    for key in given:
        if key not in known:
            raise ValueError(f"{name} has no field {key!r}; it has {', '.join(known)}")
    return classes[name](**given)


def _below(cls: type) -> Iterator[type]:
    for child in cls.__subclasses__():
        yield child
        yield from _below(child)


def _plain(value: Any) -> Any:
    if isinstance(value, float) and math.isinf(value):
        return str(value)
    if isinstance(value, tuple):
        return [_plain(part) for part in value]
    return value


def _immutable(value: Any) -> Any:
    return tuple(_immutable(part) for part in value) if isinstance(value, list) else value
