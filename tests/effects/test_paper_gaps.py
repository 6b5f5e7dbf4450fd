"""The paper's gaps, compared with a reimplementation of the authors' text edit of the MJCF."""

import re

import mujoco
import numpy as np
import pytest

from tests.effects.models import as_bytes, spec, task_xml
from torchrl_h2o.effects import PAPER_GAPS, compile_model, paper_gap

# gap: the attribute whose numbers are multiplied, and a word that selects the lines
TEXT_EDITS = {
    "gravity": ("gravity", "", 2.0),
    "friction": ("friction", "", 0.3),
    "joint_noise": None,
    "big_thigh": ("size", "thigh", 2.0),
    "small_thigh": ("size", "thigh", 0.5),
    "broken_thigh": ("range", "thigh", 0.5),
    "flexible_thigh": ("range", "thigh", 2.0),
    "long_torso": ("fromto", "torso", 4.0),
    "soft_feet": ("stiffness", "foot", 0.0),
}
COMPARED = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "geom_size", "geom_pos")
COMPARED += ("geom_friction", "jnt_range", "jnt_stiffness", "actuator_ctrlrange")


def edited_text(xml: str, attribute: str, word: str, factor: float) -> str:
    # Walker2d uses MuJoCo's default gravity, which must be written out for a text edit
    if "gravity=" not in xml:
        xml = xml.replace("<option ", '<option gravity="0 0 -9.81" ')

    def multiplied(match: re.Match) -> str:
        numbers = " ".join(repr(factor * float(number)) for number in match[1].split())
        return f'{attribute}="{numbers}"'

    # the look-behind excludes ctrlrange, which the authors' pattern changes unintentionally
    pattern = rf'(?<![a-z]){attribute}="(.*?)"'
    return "\n".join(re.sub(pattern, multiplied, line) if word in line else line for line in xml.splitlines())


CASES = [(task, name) for name, gap in PAPER_GAPS.items() for task in gap.tasks]


def test_the_table_holds_the_papers_sixteen_gaps():
    assert set(PAPER_GAPS) == set(TEXT_EDITS)
    tasks = [task for task, _ in CASES]
    assert (tasks.count("HalfCheetah"), tasks.count("Walker2d")) == (9, 7)


@pytest.mark.parametrize(("task", "name"), CASES)
def test_a_gap_compiles_to_the_model_of_the_text_edit(task, name):
    xml = task_xml(task)
    edited = edited_text(xml, *TEXT_EDITS[name]) if TEXT_EDITS[name] else xml
    expected = mujoco.MjModel.from_xml_string(edited)
    model = compile_model(spec(task), [paper_gap(name)])
    for field in COMPARED:
        np.testing.assert_array_equal(getattr(model, field), getattr(expected, field), field)
    np.testing.assert_array_equal(model.opt.gravity, expected.opt.gravity)
    unchanged = as_bytes(mujoco.MjModel.from_xml_string(xml))
    assert (as_bytes(model) == unchanged) == (name == "joint_noise")


@pytest.mark.parametrize("name", PAPER_GAPS)
def test_halfcheetah_weighs_14_kg_with_every_gap(name):
    model = compile_model(spec("HalfCheetah"), [paper_gap(name)])
    assert model.body_mass.sum() == pytest.approx(14.0, rel=1e-12)


@pytest.mark.parametrize("name", ["long_torso", "soft_feet"])
def test_a_gap_that_walker2d_does_not_have_is_refused(name):
    with pytest.raises(ValueError, match="cannot be put into model 'walker2d'"):
        compile_model(spec("Walker2d"), [paper_gap(name)])


def test_ant_has_no_thighs():
    with pytest.raises(ValueError, match=r"no geom named '\*thigh\*'; it has .*torso_geom"):
        compile_model(spec("Ant"), [paper_gap("big_thigh")])
