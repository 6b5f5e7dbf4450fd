"""The verdict: nothing missing, explained, explained in part, or not explained."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tests.residuals.pendulum import UnknownForce, double_pendulum, pendulum, recorded
from torchrl_h2o.effects import (
    ActionGain,
    ActionNoise,
    ActionSaturation,
    Armature,
    BodyMass,
    Gravity,
    JointDamping,
    JointFrictionLoss,
    ObservationDelay,
    ObservationGain,
)
from torchrl_h2o.residuals.judge.held_out_error import error_summary
from torchrl_h2o.residuals.judge.prediction_table import Predicted, predicted
from torchrl_h2o.residuals.judge.verdict import reach_verdict
from torchrl_h2o.residuals.report.contents import (
    EXPLAINED,
    EXPLAINED_IN_PART,
    NOT_EXPLAINED,
    NOTHING_MISSING,
    Verdict,
)

SIMULATION = pendulum()


def verdict(truth, found=(), noise=0.01, rows=2000, steps=5):
    """The verdict with a table of predictions some steps ahead."""
    measured = recorded(SIMULATION.with_effects(*truth), rows, noise=noise)
    mended = SIMULATION.with_effects(*found)
    error = error_summary(SIMULATION, mended, measured)
    predictions = predicted(SIMULATION, mended, measured, steps, seed=0)
    return reach_verdict(SIMULATION, mended, measured, found, error, predictions)


def learning(left, guess=100.0):
    """Predictions where a network leaves a share of the mended simulator's error, and the guess has a multiple."""
    error = 0.2 + 0.01 * np.random.default_rng(0).random((1, 300))
    losses = {
        "as_it_is": 2.0 * error,
        "mended": error,
        "velocities_stay": guess * error,
        "mended_and_network": left * error,
    }
    both = losses["as_it_is"], losses["mended"]
    return Predicted(("total",), 0.1, losses, (("elbow", "rad", 1.0),), both, (both[0][0], both[1][0]), np.zeros(1))


@cache
def right_gravity():
    """The effect that is missing, the data, and the errors with and without it."""
    found, measured = (Gravity(1.3),), recorded(SIMULATION.with_effects(Gravity(1.3)), 2000, noise=0.01)
    return found, measured, error_summary(SIMULATION, SIMULATION.with_effects(*found), measured)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_nothing_is_missing_from_an_equal_simulator(noise):
    assert verdict((), noise=noise) == Verdict(NOTHING_MISSING)


def test_a_slow_effect_shows_far_ahead():
    """One step ahead, the noise of the sensors hides it."""
    slow = verdict((JointDamping(0.02),), noise=0.003)
    assert slow.kind == NOT_EXPLAINED
    assert any("ahead" in reason for reason in slow.reasons)


def test_an_effect_that_was_not_found_is_said_to_be_missing_and_where_it_shows():
    late = UnknownForce(0.3, lambda q, v, t: (t > 27.0) + 0.0 * q)
    missing = verdict((late,))
    assert missing.kind == NOT_EXPLAINED
    assert not missing.recommended
    assert missing.where.startswith("most in elbow")


def test_the_right_effect_explains_and_is_recommended():
    right = verdict((Gravity(1.3),), (Gravity(1.3),))
    assert (right.kind, right.recommended) == (EXPLAINED, True)


def test_half_an_explanation_is_called_that():
    half = verdict((Gravity(1.5), JointFrictionLoss(0.1)), (Gravity(1.5),))
    assert half.kind == EXPLAINED_IN_PART
    assert half.recommended


@pytest.mark.parametrize(("left", "kind"), [(0.1, EXPLAINED_IN_PART), (0.001, EXPLAINED)])
def test_what_a_network_learns_counts_unless_all_errors_nearly_vanish(left, kind):
    """The sentence's quantity alone may be right by chance, such as the pitch of a robot with a larger wheel."""
    found, measured, error = right_gravity()
    head = replace(error.headline, after=0.001 * error.headline.before)
    error = replace(error, headline=head, after=left * error.before)
    reached = reach_verdict(SIMULATION, SIMULATION.with_effects(*found), measured, found, error, learning(0.5))
    assert reached.kind == kind


def test_a_small_share_of_an_absurd_error_is_no_small_error():
    """A simulator without the rotor of a light link is wrong by turns; what is left may still exceed the motion."""
    found, measured, error = right_gravity()
    error = replace(error, headline=replace(error.headline, before=1e3), before=1e3 * error.before)
    reached = reach_verdict(
        SIMULATION, SIMULATION.with_effects(*found), measured, found, error, learning(0.5, guess=2.0)
    )
    assert reached.kind == EXPLAINED_IN_PART


def test_an_effect_that_does_not_lower_the_error_is_not_recommended():
    wrong = verdict((JointFrictionLoss(0.1),), (Gravity(0.8),))
    assert wrong.kind == NOT_EXPLAINED
    assert not wrong.recommended
    assert "do not lower the error" in wrong.reasons[0]


def test_effects_that_make_a_quantity_worse_are_said_to_be_wrong():
    """Gravity is right, but no reading is scaled: the sum of all errors falls, that of the position rises."""
    wrong = verdict((Gravity(1.5),), (Gravity(1.5), ObservationGain(1.3, (1,))), rows=6000)
    assert (wrong.kind, wrong.recommended) == (NOT_EXPLAINED, False)
    (reason,) = [reason for reason in wrong.reasons if "is wrong: they raise" in reason]
    assert re.search(r"error of elbow 100 ms ahead: .* → .* mrad \(\+\d\d %\)", reason)


@pytest.mark.parametrize(("factor", "recommended"), [(1.05, True), (1.2, False)])
def test_effects_that_raise_the_error_of_the_sentence_are_not_recommended(factor, recommended):
    """No other test sees a fault here: the effect is right."""
    found, measured, error = right_gravity()
    error = replace(error, headline=replace(error.headline, after=factor * error.headline.before))
    reached = reach_verdict(SIMULATION, SIMULATION.with_effects(*found), measured, found, error, learning(1.0))
    assert reached.recommended == recommended
    assert any("raise the error of elbow" in reason for reason in reached.reasons) != recommended


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_right_effects_make_nothing_worse(noise):
    truth = (Gravity(1.3), JointFrictionLoss(0.05))
    right = verdict(truth, truth, noise)
    assert (right.kind, right.reasons) == (EXPLAINED, ())


def test_a_value_beyond_belief_is_recommended_only_if_hardly_an_error_is_left_with_it():
    light = Gravity(0.02)
    exact, in_part = (verdict(truth, (light,), noise=0.0) for truth in ((light,), (light, JointFrictionLoss(0.1))))
    assert exact.recommended
    assert exact.caveats[0].startswith("Gravity × 0.02 is implausibly far from the model's value, but hardly an error")
    assert not in_part.recommended
    assert "implausibly far" in in_part.reasons[0]


def test_a_joint_that_hardly_moves_explains_no_friction():
    """The joint is slow because of its damping. A rotor of 30 kg·m² keeps it slow too, and lowers all errors."""
    frozen = verdict((JointDamping(3.0),), (Armature(30.0),), noise=0.0, steps=10)
    assert (frozen.kind, frozen.recommended) == (NOT_EXPLAINED, False)
    (reason,) = [reason for reason in frozen.reasons if "every velocity stays as it is" in reason]
    assert "200 ms ahead, " in reason
    assert verdict((JointDamping(3.0),), (JointDamping(3.0),), noise=0.0, steps=10).kind == EXPLAINED


@pytest.mark.parametrize(("delay", "named"), [(1.0, True), (0.9995, True), (0.9, False), (0.02, False)])
def test_a_value_at_a_bound_is_named(delay, named):
    reasons = verdict((), (ObservationDelay(delay),), rows=600).reasons
    assert any("at the end of what was allowed" in reason for reason in reasons) == named


@pytest.mark.parametrize("effect", [ActionSaturation(0.6), ActionGain(-1.0), ActionGain(0.1), JointFrictionLoss(0.1)])
def test_a_value_that_a_real_machine_may_have_is_not_called_implausible(effect):
    """A saturation has no finite neutral value; a motor that is connected the wrong way round has a gain of -1."""
    assert verdict((effect,), (effect,), rows=600).reasons == ()


def test_an_unknown_kind_is_refused():
    with pytest.raises(ValueError, match="choose nothing missing"):
        Verdict("fine")


def test_action_noise_that_stands_in_for_another_cause_is_not_recommended():
    measured, found = recorded(SIMULATION.with_effects(JointFrictionLoss(0.1)), 3000, noise=0.01), (ActionNoise(0.2),)
    error = error_summary(SIMULATION, SIMULATION, measured)
    stands_in, noise_alone = (
        reach_verdict(SIMULATION, SIMULATION, measured, found, error, learning(left)) for left in (0.6, 0.95)
    )
    assert (stands_in.kind, stands_in.recommended) == (NOT_EXPLAINED, False)
    assert "a small network removes 40%" in stands_in.reasons[0]
    assert noise_alone.recommended


@pytest.mark.slow
def test_action_noise_that_was_found_is_not_missing():
    noise = ActionNoise(0.2)
    explained = verdict((noise,), (noise,), noise=0.003)
    assert explained.kind == EXPLAINED


def test_friction_beside_noise_of_its_size_gets_a_caveat():
    found = JointFrictionLoss(0.15), ActionNoise(0.2)
    (caveat,) = verdict(found, found).caveats
    assert "such noise can change the dry friction" in caveat
    assert verdict(found, found[:1]).caveats == ()


def test_a_mass_far_from_the_model_s_gets_a_caveat():
    (caveat,) = verdict((BodyMass(0.2),), (BodyMass(0.2),)).caveats
    assert "could as well be everything else × 5" in caveat


@pytest.mark.slow
def test_friction_is_recommended_although_noisy_torques_spoil_the_motion():
    """The noise is on the logged torques alone. A rotor that hides it is not recommended."""
    simulation, friction = double_pendulum(), (JointFrictionLoss(0.15, "shoulder"), JointFrictionLoss(0.08, "elbow"))
    data = recorded(simulation.with_effects(*friction), 3000, noise=0.002)
    noise = 0.3 * np.random.default_rng(0).normal(size=data.action.shape)
    noisy = replace(data, action=data.action + noise)

    def of(*found):
        mended = simulation.with_effects(*found)
        error = error_summary(simulation, mended, noisy)
        return reach_verdict(simulation, mended, noisy, found, error, predicted(simulation, mended, noisy, 20, seed=0))

    assert of(*friction).recommended
    rotor = of(Armature(0.1, "elbow"))
    assert not rotor.recommended
    assert any("hardly better than by the guess" in reason for reason in rotor.reasons)


def test_effects_whose_value_the_data_leave_open_are_not_recommended():
    effect = JointFrictionLoss(0.1)
    measured = recorded(SIMULATION.with_effects(effect), 1500)
    mended = SIMULATION.with_effects(effect)
    error, predictions = error_summary(SIMULATION, mended, measured), predicted(SIMULATION, mended, measured, 5, seed=0)
    plain, left_open = (
        reach_verdict(SIMULATION, mended, measured, (effect,), error, predictions, undetermined=reasons)
        for reasons in ((), ("'friction' is not determined by the data",))
    )
    assert plain.recommended
    assert not left_open.recommended
    assert "'friction' is not determined by the data" in left_open.reasons
