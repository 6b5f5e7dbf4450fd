"""End to end: the effect put into the real pendulum is the only one reported, with its value."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from tests.residuals.pendulum import XML, UnknownForce, pendulum, recorded
from torchrl_h2o.effects import (
    ActionDelay,
    ActionGain,
    ActionNoise,
    BodyMass,
    CatalogueEntry,
    Gravity,
    JointFrictionLoss,
)
from torchrl_h2o.residuals import Report, Simulation, Split, close_the_loop, residuals

SIMULATION = pendulum()
GRAVITY = CatalogueEntry(Gravity(), ({"scale": 0.8}, {"scale": 1.25}))
FRICTION = CatalogueEntry(JointFrictionLoss(), ({"torque": 0.01}, {"torque": 0.1}))
ROWS = 5000


def closed(measured, simulation=SIMULATION, catalogue=None, **kwargs):
    return close_the_loop(simulation, measured, catalogue, progress=False, **kwargs)


@pytest.mark.slow
@pytest.mark.parametrize(
    "truth",
    [Gravity(1.3), JointFrictionLoss(0.05), ActionDelay(0.013)],
    ids=lambda effect: type(effect).__name__,
)
def test_the_missing_effect_is_named_first_with_its_value(truth):
    report = closed(recorded(SIMULATION.with_effects(truth), ROWS))
    (found,) = report.found
    (name,) = truth.parameters
    value = truth.parameters[name].value
    assert type(found.effect) is type(truth)
    assert found.declared
    assert found.effect.parameters[name].value == pytest.approx(value, rel=0.02)
    low, high = found.ci95[name]
    assert low <= found.effect.parameters[name].value <= high
    assert report.error.after < 0.01 * report.error.before
    assert found.words in report.sentence()


def test_where_nothing_is_missing_nothing_is_named():
    report = closed(recorded(SIMULATION, 800))
    assert report.effects == ()
    assert report.sentence().startswith("Nothing is missing")


@pytest.mark.slow
def test_noise_of_the_sensors_is_no_effect():
    report = closed(recorded(SIMULATION, 2000, noise=0.01))
    assert report.effects == ()
    assert report.error.after == report.error.before


def with_xml(*changes: tuple[str, str]) -> Simulation:
    xml = XML
    for old, new in changes:
        assert old in xml
        xml = xml.replace(old, new)
    return replace(SIMULATION, spec=lambda: mujoco.MjSpec.from_string(xml))


def test_mass_and_gain_are_one_group_where_the_data_cannot_tell_them_apart():
    """About a vertical axle gravity has no effect; without damping, doubling the mass equals halving the gain."""
    flat = with_xml(('axis="0 1 0" damping="0.1"', 'axis="0 0 1"'), ("0 0 0 0 0 -0.5", "0 0 0 0 -0.5 0"))
    mass = CatalogueEntry(BodyMass(), ({"scale": 0.8}, {"scale": 1.25}))
    gain = CatalogueEntry(ActionGain(), ({"scale": 0.8}, {"scale": 1.25}))
    report = closed(recorded(flat.with_effects(BodyMass(1.4)), 1000), flat, [mass, gain, FRICTION])
    (group,) = report.indistinguishable
    effects = {type(effect): effect for effect in group.effects}
    assert set(effects) == {BodyMass, ActionGain}
    assert effects[BodyMass].scale == pytest.approx(1.4, rel=0.02)
    assert effects[ActionGain].scale == pytest.approx(1.0 / 1.4, rel=0.02)
    assert len(report.effects) == 1
    assert "These data cannot tell" in report.sentence()


@pytest.mark.slow
def test_mass_and_gain_are_told_apart_where_weight_shows():
    mass = CatalogueEntry(BodyMass(), ({"scale": 0.8}, {"scale": 1.25}))
    gain = CatalogueEntry(ActionGain(), ({"scale": 0.8}, {"scale": 1.25}))
    report = closed(recorded(SIMULATION.with_effects(ActionGain(0.7)), 1000), catalogue=[mass, gain])
    assert [effect.describe() for effect in report.effects] == ["all actuators × 0.7"]
    assert report.indistinguishable == ()


def test_a_torque_on_no_list_is_marked_so_and_explained():
    ripple = UnknownForce(0.2, lambda q, v, t: np.sin(7.0 * q))
    report = closed(recorded(SIMULATION.with_effects(ripple), 1200), catalogue=[GRAVITY, FRICTION])
    assert [found.declared for found in report.found] == [False]
    assert report.error.after < 0.2 * report.error.before
    assert report.sentence().startswith("Your simulator lacks: outside the catalogue: torque on joint elbow")


def test_two_effects_are_found_together():
    report = closed(
        recorded(SIMULATION.with_effects(Gravity(1.3), JointFrictionLoss(0.05)), 600), catalogue=[GRAVITY, FRICTION]
    )
    found = {type(effect): effect for effect in report.effects}
    assert found[Gravity].scale == pytest.approx(1.3, rel=0.02)
    assert found[JointFrictionLoss].torque == pytest.approx(0.05, rel=0.02)
    assert len(found) == len(report.effects) == 2


@pytest.mark.slow
def test_noise_of_the_action_is_named():
    free = with_xml(('ctrlrange="-1 1"', ""))
    (noise,) = closed(recorded(free.with_effects(ActionNoise(0.2)), 3000), free).effects
    assert isinstance(noise, ActionNoise)
    assert noise.std == pytest.approx(0.2, rel=0.1)


@pytest.mark.slow
def test_noise_of_the_action_that_the_control_range_cuts_off_is_no_saturation():
    (noise,) = closed(recorded(SIMULATION.with_effects(ActionNoise(0.2)), 3000, seed=3)).effects
    assert isinstance(noise, ActionNoise)
    assert noise.std == pytest.approx(0.2, rel=0.1)


@pytest.mark.slow
def test_noise_that_only_the_simulator_has_is_taken_away():
    simulation = SIMULATION.with_effects(ActionNoise(1.0))
    report = closed(recorded(SIMULATION, 2000), simulation)
    assert report.effects == (ActionNoise(-1.0),)
    measured = recorded(SIMULATION, 300)
    mended = simulation.with_effects(*report.effects)
    assert np.abs(residuals(mended, measured, measured.windows(1), rng=np.random.default_rng(0))).max() < 1e-9


def test_too_few_rows_are_no_conclusion_and_it_is_said_why():
    report = closed(recorded(SIMULATION.with_effects(Gravity(2.0)), 150))
    assert report.effects == ()
    assert report.error is None
    assert "150 usable transitions are too few" in report.conclusion
    assert report.conclusion in report.sentence()


def test_data_in_which_nothing_moves_are_no_conclusion():
    measured = recorded(SIMULATION, 300)
    still = replace(measured, observation=np.zeros((300, 2)), following=np.zeros((300, 2)))
    assert "no observed value changes" in closed(still).conclusion


def test_a_sensor_that_is_off_is_no_conclusion_and_it_is_said_which():
    measured = recorded(SIMULATION, 300)
    dead = np.array([1.0, 0.0])
    off = replace(measured, observation=measured.observation * dead, following=measured.following * dead)
    assert "entries 1 never change" in closed(off).conclusion


def test_a_simulator_that_diverges_is_no_conclusion():
    measured = recorded(SIMULATION, 300)
    far = replace(measured, observation=1e12 * measured.observation, following=1e12 * measured.following)
    assert "diverges within one step of" in closed(far).conclusion


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"data": {"observation": np.zeros((3, 2))}}, r"data=<class 'dict'>: must be a TensorDict"),
        ({"catalogue": "gravity"}, "catalogue='gravity': must be a list of CatalogueEntry"),
        ({"known": "gravity"}, "known='gravity': must be a list of effects"),
        ({"known": ["gravity"]}, r"known=\['gravity'\]: must be a list of effects"),
        ({"seed": "a"}, "seed='a': must be a whole number, 0 or more"),
        ({"seed": -1}, "seed=-1: must be"),
        ({"minutes": -1}, "minutes=-1: must be a number above 0"),
        ({"minutes": "8"}, "minutes='8': must be"),
        ({"held_out": float("nan")}, "held_out=nan: must be a share above 0 and below 1"),
        ({"held_out": 1.5}, "held_out=1.5: must be"),
    ],
)
def test_an_argument_that_cannot_be_used_is_named(arguments, said):
    rest = {"data": recorded(SIMULATION, 100), "progress": False}
    with pytest.raises(ValueError, match=f"^{said}"):
        close_the_loop(SIMULATION, **(rest | arguments))


def test_a_progress_bar_is_shown_only_if_asked(capsys):
    measured = recorded(SIMULATION.with_effects(Gravity(1.3)), 300)
    close_the_loop(SIMULATION, measured, [GRAVITY], progress=False)
    quiet = capsys.readouterr()
    close_the_loop(SIMULATION, measured, [GRAVITY], progress=True)
    shown = capsys.readouterr()
    assert "closing the loop" not in quiet.out + quiet.err
    assert quiet.out == shown.out
    assert "reporting" in shown.err


@pytest.mark.slow
def test_the_same_seed_gives_the_same_report():
    measured = recorded(SIMULATION.with_effects(Gravity(1.3)), 600, noise=0.005)
    first, again = (
        replace(closed(measured, catalogue=[GRAVITY, FRICTION], seed=3), wall_s=None, made_by={}) for _ in range(2)
    )
    assert first.to_json() == again.to_json()


@pytest.mark.slow
def test_what_is_in_the_simulator_is_not_found_again():
    half = SIMULATION.with_effects(Gravity(1.3))
    report = closed(recorded(half.with_effects(JointFrictionLoss(0.05)), 1000), half, [GRAVITY, FRICTION])
    (friction,) = report.effects
    assert friction.torque == pytest.approx(0.05, rel=0.02)


def test_held_out_rows_are_not_fitted():
    """Gravity changes where the report's rows begin; the fit returns the value before it."""
    before, after = (recorded(SIMULATION.with_effects(Gravity(scale)), 1000) for scale in (1.3, 1.5))
    late = before.held_out[:, None]
    measured = replace(
        before,
        observation=np.where(late, after.observation, before.observation),
        following=np.where(late, after.following, before.following),
    )
    (gravity,) = closed(measured, catalogue=[GRAVITY]).effects
    assert gravity.scale == pytest.approx(1.3, rel=0.02)


@pytest.mark.parametrize(("rows", "known"), [(6, False), pytest.param(300, True, marks=pytest.mark.slow)])
def test_where_rows_are_too_few_to_choose_by_the_catalogue_is_not_said_to_lack_the_cause(rows, known):
    measured = recorded(SIMULATION.with_effects(Gravity(1.3)), 1200, noise=0.01)
    split = np.full(1200, Split.FIT)
    split[700 : 700 + rows], split[700 + rows :] = Split.SELECTION, Split.REPORT
    report = closed(replace(measured, split=split), catalogue=[GRAVITY])
    assert bool(report.found) == known
    if not known:
        words = report.sentence()
        assert "these data do not tell what" in words
        assert "For example, gravity × 1.3" in words
        assert f"the {rows} rows by which effects are chosen are too few" in words
        assert "catalogue" not in words
        assert report.verdict == Report.from_json(report.to_json()).verdict
