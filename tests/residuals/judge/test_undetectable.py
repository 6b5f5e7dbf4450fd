"""Effects that data could not have shown, named where nothing is missing."""

from dataclasses import replace

import numpy as np
import pytest

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import ActionNoise, ActionSaturation, CatalogueEntry, Gravity, GravityTilt, JointDamping
from torchrl_h2o.residuals import Split, close_the_loop
from torchrl_h2o.residuals.judge.undetectable import undetectable_effects
from torchrl_h2o.residuals.settings import LoopSettings

SIMULATION = pendulum()
GRAVITY = CatalogueEntry(Gravity(), ({"scale": 0.5}, {"scale": 0.8}, {"scale": 2.0}))
DAMPING = CatalogueEntry(JointDamping(), ({"damping": 1e-6}, {"damping": 1e-3}))
STRONG = CatalogueEntry(JointDamping(), ({"damping": 1e-6}, {"damping": 0.5}))
NOISE = CatalogueEntry(ActionNoise(), ({"std": 0.1},))


QUICK = LoopSettings(classifier_updates=20)  # the classifier has its own tests


def missed(*catalogue, noise):
    return undetectable_effects(SIMULATION, recorded(SIMULATION, 1000, noise=noise), catalogue)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_effects_that_change_less_than_the_noise_are_missed(noise):
    found = [] if noise == 0.0 else [JointDamping(1e-3)]
    assert list(missed(GRAVITY, STRONG, NOISE, noise=noise)) == []
    assert list(missed(GRAVITY, DAMPING, noise=noise)) == found


def test_each_direction_is_judged_alone():
    little = CatalogueEntry(Gravity(), ({"scale": 0.5}, {"scale": 1.0001}))
    assert missed(little, noise=0.01) == (Gravity(1.0001),)


def test_an_effect_of_several_parameters_is_missed_where_all_its_trials_are():
    seen = CatalogueEntry(GravityTilt(), ({"pitch": 0.3, "roll": 0.0}, {"pitch": 1e-6, "roll": 0.0}))
    unseen = CatalogueEntry(GravityTilt(), ({"pitch": 1e-6, "roll": 0.0}, {"pitch": 0.0, "roll": 0.01}))
    assert missed(seen, noise=0.01) == ()
    assert len(missed(unseen, noise=0.01)) == 1  # a tilt about the pendulum's own plane does nothing


def test_of_a_limit_without_an_end_the_smallest_is_judged():
    unreached = CatalogueEntry(ActionSaturation(), ({"limit": 0.2}, {"limit": 5.0}))
    assert missed(unreached, noise=0.01) == ()


def test_a_slow_effect_is_detectable_because_a_search_would_lengthen_its_windows():
    slow = CatalogueEntry(JointDamping(), ({"damping": 0.006},))
    assert missed(slow, noise=0.01) == ()
    measured = recorded(SIMULATION, 1000, noise=0.01)
    short = LoopSettings(window_seconds=())
    assert undetectable_effects(SIMULATION, measured, [slow], settings=short) == (JointDamping(0.006),)


def test_a_trial_that_the_model_rejects_is_left_out():
    rejected = CatalogueEntry(JointDamping(), ({"damping": -5.0}, {"damping": 1e-6}))
    assert missed(rejected, noise=0.01) == (JointDamping(1e-6),)


def test_the_largest_of_each_kind_comes_first():
    tiny = CatalogueEntry(JointDamping(), ({"damping": -1e-7}, {"damping": 1e-6}))
    flat = CatalogueEntry(Gravity(), ({"scale": 0.999999}, {"scale": 1.0001}))
    kinds = [type(effect) for effect in missed(tiny, flat, noise=0.01)]
    assert len(kinds) == 4
    assert set(kinds[:2]) == {JointDamping, Gravity}


def test_without_data_for_a_choice_nothing_is_said():
    measured = recorded(SIMULATION, 200)
    measured = replace(measured, split=np.full(len(measured), Split.FIT))
    assert undetectable_effects(SIMULATION, measured, [DAMPING]) == ()


def test_a_report_that_finds_nothing_names_them():
    measured = recorded(SIMULATION, 1000, noise=0.01)
    report = close_the_loop(SIMULATION, measured, [GRAVITY, DAMPING], progress=False, settings=QUICK)
    assert report.effects == ()
    assert report.sentence().startswith("Nothing is missing")
    assert report.sentence().endswith(
        "Noise or a lack of motion would hide in these data: damping of all joints + 0.001 N·m·s/rad."
    )
