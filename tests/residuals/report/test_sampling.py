"""Draws from what a report leaves open: their distribution, and the alternatives among them."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from torchrl.envs import GymEnv, TransformedEnv

from tests.residuals.report.made_up_reports import DATA, full_report, nothing_missing
from torchrl_h2o.effects import ActionDelay, ActionGain, BodyMass, Gravity, JointDamping
from torchrl_h2o.envs import DynamicsGap
from torchrl_h2o.residuals import Measured, Simulation, close_the_loop, residuals
from torchrl_h2o.residuals.report.contents import FoundEffect, IndistinguishableGroup, OtherExplanation
from torchrl_h2o.residuals.report.document import Report


def report(*found, groups=()):
    parts = (FoundEffect(effect, True, ci95, 0.1) for effect, ci95 in found)
    return Report(simulator="pendulum.xml", data=DATA, found=tuple(parts), indistinguishable=groups)


def group(first, *explanations):
    """Alternatives to an effect; each explanation begins with the alternative, followed by the effects beside it."""
    effects = (first, *(explanation[0][0] for explanation in explanations))
    return IndistinguishableGroup(effects, (0.1,) * len(effects), together=((), *explanations))


def test_values_are_normal_with_the_interval_of_the_report():
    draws = report((Gravity(0.5), {"scale": (0.4, 0.6)})).sample(1500)
    scales = np.array([gravity.scale for (gravity,) in draws])
    assert scales.mean() == pytest.approx(0.5, abs=0.006)
    assert scales.std() == pytest.approx(0.1 / 1.96, rel=0.08)
    assert ((scales > 0.4) & (scales < 0.6)).mean() == pytest.approx(0.95, abs=0.02)


def test_values_stay_within_the_bounds_of_the_parameter():
    draws = report((ActionDelay(0.001), {"delay": (-0.02, 0.022)})).sample(500)
    delays = np.array([delay.delay for (delay,) in draws])
    low, high = ActionDelay().parameters["delay"].bounds
    assert ((delays >= low) & (delays <= high)).all()
    assert len(set(delays)) > 450  # truncated, not clipped to the bound


def test_draws_repeat_with_their_seed_and_a_longer_sample_begins_with_the_shorter_one():
    assert full_report().sample(6) == full_report().sample(6) != full_report().sample(6, seed=1)
    assert full_report().sample(9)[:6] == full_report().sample(6)
    assert len(set(full_report().sample(20))) == 20


def test_other_sets_of_effects_are_drawn_as_often_as_the_effects_found():
    found = report((Gravity(0.5), {}))
    other = OtherExplanation((BodyMass(1.2), JointDamping(0.1)), 0.1)
    draws = dataclasses.replace(found, others=(other,)).sample(1000)
    assert set(draws) == {(Gravity(0.5),), (BodyMass(1.2), JointDamping(0.1))}
    assert draws.count(other.effects) == pytest.approx(500, abs=60)


def test_every_explanation_that_the_data_allow_is_drawn_equally_often():
    mass, damping = (BodyMass(1.2), {"scale": (1.15, 1.25)}), (JointDamping(0.1), {"damping": (0.09, 0.11)})
    gain, gravity = (ActionGain(0.8), {"scale": (0.78, 0.82)}), (Gravity(0.9), {})
    other = (JointDamping(0.3), {"damping": (0.29, 0.31)})  # beside the gain
    draws = report(mass, damping, groups=(group(mass[0], (gain, other)), group(damping[0], (gravity, mass)))).sample(
        900
    )
    kinds = [tuple(type(effect) for effect in draw) for draw in draws]
    chosen = {(BodyMass, JointDamping), (ActionGain, JointDamping), (Gravity, BodyMass)}  # never two in one draw
    assert set(kinds) == chosen
    for kind in chosen:
        assert kinds.count(kind) == pytest.approx(300, abs=60)
    gains = np.array([draw[0].scale for draw in draws if isinstance(draw[0], ActionGain)])
    assert gains.std() == pytest.approx(0.02 / 1.96, rel=0.15)
    for first, beside in draws:
        if isinstance(beside, JointDamping):
            assert beside.damping == pytest.approx(0.3 if isinstance(first, ActionGain) else 0.1, abs=0.03)


def test_a_parameter_without_an_interval_keeps_its_value():
    for intervals in ({}, {"scale": (math.nan, math.nan)}, {"scale": (0.5, 0.5)}):
        assert set(report((Gravity(0.5), intervals)).sample(5)) == {(Gravity(0.5),)}


def test_a_report_without_effects_gives_empty_draws():
    assert nothing_missing().sample(3) == [(), (), ()]
    with pytest.raises(ValueError, match="n is -1"):
        nothing_missing().sample(-1)


def test_a_saved_report_gives_the_same_draws(tmp_path):
    mass, gain = (BodyMass(1.2), {"scale": (1.15, 1.25)}), (ActionGain(0.8), {"scale": (0.78, 0.82)})
    whole = report(mass, groups=(group(mass[0], (gain,)),))
    again = Report.load(whole.save(tmp_path))
    assert again == whole
    assert again.sample(20) == whole.sample(20)


def test_alternatives_of_earlier_files_are_drawn_with_their_values():
    mass, gain = (BodyMass(1.2), {"scale": (1.15, 1.25)}), (ActionGain(0.8), {"scale": (0.78, 0.82)})
    entries = report(mass, groups=(group(mass[0], (gain,)),)).to_json()
    for member in entries["indistinguishable"][0]["effects"]:
        del member["together"]
    drawn = {effect for (effect,) in Report.from_json(entries).sample(20)}
    assert ActionGain(0.8) in drawn
    assert all(isinstance(effect, BodyMass) for effect in drawn - {ActionGain(0.8)})


def test_an_explanation_is_given_for_each_effect_of_a_group():
    with pytest.raises(ValueError, match="a group of 2 effects has 1 explanations"):
        dataclasses.replace(group(BodyMass(1.2), ((ActionGain(0.8), {}),)), together=((),))


@pytest.mark.slow
def test_every_draw_of_a_search_explains_the_data():
    """Half the mass with half the torque is the same motion, so an alternative needs another damping beside it."""
    gap = DynamicsGap(ActionGain(0.7), JointDamping(0.5))
    env = TransformedEnv(GymEnv("InvertedPendulum-v5"), gap)
    env.set_seed(0)
    torch.manual_seed(0)
    measured = env.rollout(800, break_when_any_done=False)
    simulation = Simulation.from_env(GymEnv("InvertedPendulum-v5"))
    tried = (ActionGain, JointDamping, BodyMass)
    catalogue = [entry for entry in simulation.catalogue() if isinstance(entry.effect, tried)]
    found = close_the_loop(simulation, measured, catalogue, progress=False)
    assert found.indistinguishable
    draws = found.sample(12)
    assert len({tuple(type(effect) for effect in draw) for draw in draws}) > 1
    data = Measured.from_ted(measured, simulation)
    for draw in draws:
        missed = residuals(simulation.with_effects(*draw), data, data.reported_on())
        before = residuals(simulation, data, data.reported_on())
        assert np.sqrt((missed**2).mean()) < 1e-4 * np.sqrt((before**2).mean())
