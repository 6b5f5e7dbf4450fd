"""Effects that data could not have shown, named where nothing is missing."""

import numpy as np
import pytest

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import ActionNoise, CatalogueEntry, Gravity, GravityTilt, JointDamping
from torchrl_h2o.residuals import close_the_loop
from torchrl_h2o.residuals.judge.undetectable import undetectable_effects, undetectable_words

SIMULATION = pendulum()
GRAVITY = CatalogueEntry(Gravity(), ({"scale": 0.5}, {"scale": 0.8}, {"scale": 2.0}))
DAMPING = CatalogueEntry(JointDamping(), ({"damping": 1e-6}, {"damping": 1e-3}))
STRONG = CatalogueEntry(JointDamping(), ({"damping": 1e-6}, {"damping": 0.5}))
NOISE = CatalogueEntry(ActionNoise(), ({"std": 0.1},))


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
    unseen = CatalogueEntry(GravityTilt(), ({"pitch": 1e-6, "roll": 0.0}, {"pitch": 0.0, "roll": 0.3}))
    assert missed(seen, noise=0.01) == ()
    assert len(missed(unseen, noise=0.01)) == 1  # a tilt about the pendulum's own plane does nothing


def test_the_sentence_names_one_effect_of_each_kind_and_counts_the_others():
    assert undetectable_words(()) == ()
    assert undetectable_words((Gravity(2.0),)) == ("These data could not have shown: gravity × 2.",)
    words = undetectable_words((JointDamping(0.1), JointDamping(0.2), Gravity(2.0)))
    assert words == (
        "These data could not have shown: damping of all joints + 0.1 N·m·s/rad, gravity × 2 or 1 more effect of the "
        "catalogue.",
    )


def test_a_report_that_finds_nothing_names_them():
    report = close_the_loop(SIMULATION, recorded(SIMULATION, 1000, noise=0.01), [GRAVITY, DAMPING], progress=False)
    assert report.effects == ()
    assert report.sentence().startswith("Nothing is missing")
    assert report.sentence().endswith("These data could not have shown: damping of all joints + 0.001 N·m·s/rad.")
    assert np.isfinite(report.error.after)
