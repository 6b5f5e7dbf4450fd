"""Conversion of effects to JSON-compatible dictionaries and back."""

import json
from dataclasses import dataclass
from typing import ClassVar

import mujoco
import pytest

from tests.effects.every_effect import EFFECTS
from torchrl_h2o.effects import (
    ActionDelay,
    ActionSaturation,
    GravityTilt,
    ModelEffect,
    ObservationBias,
    Payload,
    effect_from_dict,
    effect_to_dict,
    parameter,
)

NEUTRAL = [effect() for effect in EFFECTS]
OTHERS = [
    ActionSaturation(),
    ActionSaturation(0.3, actuators=(0, 2)),
    ActionDelay(0.1, actuators=1),
    Payload(1.0, x=0.1, bodies=("torso", "head")),
    GravityTilt(pitch=-0.1),
    ObservationBias(0.1, entries=(3,)),
]


@pytest.mark.parametrize("effect", NEUTRAL + OTHERS)
def test_an_effect_comes_back_from_json_as_it_was(effect):
    text = json.dumps(effect_to_dict(effect), allow_nan=False)
    assert effect_from_dict(json.loads(text)) == effect


def test_an_effect_defined_elsewhere_is_found():
    @dataclass(frozen=True)
    class Magnetism(ModelEffect):
        wording: ClassVar[str] = "magnetism of {strength}"
        strength: float = parameter(unit="T", bounds=(0.0, 1.0), neutral=0.0)

        def edit(self, spec: mujoco.MjSpec) -> None:
            spec.option.magnetic = [0.0, 0.0, self.strength]

    assert effect_from_dict(effect_to_dict(Magnetism(0.5))) == Magnetism(0.5)


@pytest.mark.parametrize("name", ["Levity", "Effect", "ModelEffect", None])
def test_an_unknown_effect_is_answered_with_those_there_are(name):
    with pytest.raises(ValueError, match=rf"no effect named {name!r}; choose one of ActionBacklash, .*Timestep"):
        effect_from_dict({"effect": name})


def test_an_unknown_field_or_an_illegal_value_is_refused():
    with pytest.raises(ValueError, match="Gravity has no field 'size'; it has scale"):
        effect_from_dict({"effect": "Gravity", "size": 1.0})
    with pytest.raises(ValueError, match="Gravity: scale = -1 lies outside"):
        effect_from_dict({"effect": "Gravity", "scale": -1.0})
