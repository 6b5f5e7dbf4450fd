"""YAML layouts of logs, and units."""

import math

import pytest

from torchrl_h2o.data import Column, DataError, LogColumns
from torchrl_h2o.data.readers.units import UNITS, to_si

GOOD = """
separator: ","
header: true
dt: 5e-3
columns:
  - {name: pitch, role: observation, unit: deg}
  - {name: wheel, role: observation, unit: rpm, scale: -0.5}
  - {name: torque, role: action, unit: mN·m, bounds: [-3, 3]}
observation: [wheel, pitch]
"""


def load(tmp_path, text):
    path = tmp_path / "columns.yaml"
    path.write_text(text, encoding="utf-8")
    return LogColumns.load(path)


def test_yaml_is_read(tmp_path):
    layout = load(tmp_path, GOOD)
    assert layout.observation == ("wheel", "pitch")
    assert layout.action == ("torque",)
    assert layout.dt == 0.005  # YAML 1.1 reads 5e-3 as a string
    assert layout.columns[1].factor == pytest.approx(-0.5 * 2 * math.pi / 60)
    assert layout.columns[2].bounds == (-3.0, 3.0)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("dt: 5e-3", "dt: 0", "dt 0.0 must be a positive"),
        ("dt: 5e-3", "", "dt is missing"),
        ("dt: 5e-3", "dt: fast", "dt: 'fast' is not a number"),
        ("dt: 5e-3", "rate: 200", "unknown entry 'rate'; choose from columns, dt"),
        ("unit: deg", "units: deg", "unknown entry 'units'"),
        ("unit: deg", "unit: furlong", "'pitch'.*unknown unit 'furlong'; choose from .*deg"),
        ("name: wheel", "name: pitch", "column name 'pitch' occurs 2 times"),
        ("role: action", "role: motor", "unknown role 'motor'; choose from observation"),
        ("role: action", "role: ignore", "bounds are for actions only"),
        (", bounds: [-3, 3]", ", bounds: [3, -3]", "must be .lowest, highest."),
        (", bounds: [-3, 3]", ", bounds: [3]", r"bounds: \[3\] must be \[lowest, highest\]"),
        ("role: action, unit: mN·m, bounds: [-3, 3]", "role: ignore", "no column.*'action'"),
        ("[wheel, pitch]", "[wheel]", "observation: .*must name each of"),
        ("[wheel, pitch]", "[wheel, wheel]", "observation: .*must name each of"),
        ("scale: -0.5", "scale: 0", "scale 0.0 must be finite and not zero"),
        ('separator: ","', 'separator: "ab"', "separator 'ab'"),
        ("header: true", "header: perhaps", "header 'perhaps' must be one of"),
        ("role: observation, unit: deg", "role: time, unit: deg", "is not a unit of time"),
        ("role: observation, unit: deg", "unit: deg", "role"),
        ("columns:", "columns: [", "invalid YAML"),
        ("dt: 5e-3", "dt: 5e-3\ndt: 1", "row 5: duplicate entry 'dt'"),
        ("unit: deg", "unit: deg, unit: rad", "duplicate entry 'unit'"),
        ("dt: 5e-3", "? [dt]\n: 1", "row 4: found unhashable key"),
        ("dt: 5e-3", "dt: 5ms", "dt: '5ms' is not a number"),
        ("dt: 5e-3", "dt: yes", "dt: True is not a number"),
        ("dt: 5e-3", "dt: 1\ntime_tolerance: wide", "time_tolerance: 'wide' is not a number"),
        ("dt: 5e-3", "dt: 1\ntime_tolerance: .nan", "time_tolerance nan must be positive"),
        ("scale: -0.5", "scale: left", "'wheel'.*scale: 'left' is not a number"),
        ("scale: -0.5", "scale: [1]", r"scale: \[1\] is not a number"),
        ("[-3, 3]", "3", r"bounds: 3 must be \[lowest, highest\]"),
        ("[-3, 3]", "[-3, x]", "bounds: 'x' is not a number"),
        ("name: wheel", "name: on", "'True'.*name True is not a string: quote it"),
        ("name: wheel", "name: 1", "name 1 is not a string: quote it"),
        ("[wheel, pitch]", "[wheel, on]", "observation: .*True.* must be a list of column names"),
        ("[wheel, pitch]", "wheel", "observation: 'wheel' must be a list of column names"),
        ('separator: ","', "separator: 1", "separator 1 must be"),
        ('separator: ","', "separator: null", "separator None must be"),
    ],
)
def test_contradiction_is_refused(tmp_path, old, new, message):
    assert old in GOOD
    with pytest.raises(DataError, match=message) as caught:
        load(tmp_path, GOOD.replace(old, new, 1))
    assert caught.value.source.endswith("columns.yaml")


@pytest.mark.parametrize("text", ["", "- a", "columns: 3", "columns: [a, b]"])
def test_other_yaml_is_refused(tmp_path, text):
    with pytest.raises(DataError, match=r"not a mapping|not a list"):
        load(tmp_path, text)


def test_missing_yaml_is_refused_with_those_there_are():
    with pytest.raises(DataError, match=r"simple_pendulum.*wheel_legged_standing_still"):
        LogColumns.load("wheel_legged")


@pytest.mark.parametrize("role", ["time", "done", "reward"])
def test_single_roles_stand_once(role):
    columns = (Column("x", "observation"), Column("u", "action"))
    unit = "s" if role == "time" else "1"
    twice = (Column("a", role, unit), Column("b", role, unit))
    with pytest.raises(ValueError, match=f"several columns have the role '{role}'"):
        LogColumns((*columns, *twice), dt=1.0)


@pytest.mark.parametrize(
    ("unit", "expected"),
    [
        ("deg/s", ("rad/s", math.pi / 180)),
        ("°", ("rad", math.pi / 180)),
        ("rpm", ("rad/s", 2 * math.pi / 60)),
        ("mN*m", ("N·m", 1e-3)),
        ("N m", ("N·m", 1.0)),
        ("m/s²", ("m/s2", 1.0)),
        ("m/s^2", ("m/s2", 1.0)),
        ("µs", ("s", 1e-6)),
        ("km/h", ("m/s", 1000 / 3600)),
    ],
)
def test_units_become_si(unit, expected):
    name, factor = to_si(unit)
    assert name == expected[0]
    assert factor == pytest.approx(expected[1])


def test_every_si_unit_is_its_own():
    for si_unit, _ in UNITS.values():
        assert to_si(si_unit) == (si_unit, 1.0)
