"""Columns whose names have characters with a meaning on Hydra's command line."""

import string

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from torchrl_h2o.commands.column_names import as_key, column_of

NAMES = [
    "Angle (rad)",
    "Speed (rad/sec)",
    "q[0]",
    "pitch °",
    "θ_1",
    "a, b",
    "a=b",
    "c:d",
    "12",
    *(f"x{c}y" for c in string.punctuation),
]


@pytest.mark.parametrize("name", NAMES)
def test_a_key_of_a_mapping_is_read_back_as_the_column(name):
    override = f"simulator.coordinates={{{as_key(name)}: hip, other: knee}}"
    read = OverridesParser.create().parse_override(override).value()
    keys = [key for key, coordinate in read.items() if coordinate == "hip"]
    assert [column_of(key, ["other", name]) for key in keys] == [name]


def test_a_key_that_two_columns_are_written_like_names_neither():
    assert column_of("angle", ["angle °", "angle '"]) is None
    assert column_of("angle", ["angle", "angle '"]) == "angle"
