"""Effects on mass, centre of mass and inertia of bodies."""

import mujoco
import numpy as np
import pytest

from tests.effects.models import CART, as_bytes, spec
from torchrl_h2o.effects import BodyCentreOfMass, BodyInertia, BodyMass, GeomSize, Payload, PseudoInertia, compile_model

INERTIAL = ("body_mass", "body_ipos", "body_inertia")
# with inertiafromgeom="true" the compiler ignores the inertial of "derived", which has a geom, and uses that of "given"
IGNORED = """
<mujoco model="ignored"><compiler inertiafromgeom="true"/><worldbody>
  <body name="given"><joint axis="0 1 0"/><inertial pos=".1 0 0" mass="3" diaginertia="1 2 2.5"/>
    <body name="derived"><joint axis="0 1 0"/><inertial pos=".1 0 0" mass="3" diaginertia="1 2 2.5"/>
      <geom size=".1"/></body>
    <body name="other"><joint axis="0 1 0"/><geom size=".2 .1 .3" type="box" euler="10 20 30"/></body>
  </body>
</worldbody></mujoco>"""
MODELS = ["HalfCheetah", "Walker2d", "Ant", CART, IGNORED]


def inertia_of(model: mujoco.MjModel, body: str) -> np.ndarray:
    """Returns the inertia (3, 3) about the centre of mass, in the body's frame."""
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, model.body(body).iquat)
    axes = axes.reshape(3, 3)
    return axes @ np.diag(model.body(body).inertia) @ axes.T


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("effect", [BodyInertia(2.0), BodyCentreOfMass(x=0.1), Payload(0.5, z=0.1)])
def test_every_body_that_is_not_chosen_keeps_its_inertial(model, effect):
    before = compile_model(spec(model))
    for chosen in range(1, before.nbody):
        name = before.body(chosen).name
        if not name:
            continue
        after = compile_model(spec(model), [type(effect)(**{**vars(effect), "bodies": name})])
        others = [body for body in range(before.nbody) if body != chosen]
        for field in INERTIAL:
            np.testing.assert_allclose(getattr(after, field)[others], getattr(before, field)[others], rtol=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_inertia_is_scaled_at_the_same_mass(model):
    before, after = compile_model(spec(model)), compile_model(spec(model), [BodyInertia(1.5)])
    np.testing.assert_allclose(after.body_mass, before.body_mass, rtol=1e-9)
    for body in range(1, before.nbody):
        expected = 1.5 * inertia_of(before, body)
        np.testing.assert_allclose(inertia_of(after, body), expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_the_centre_of_mass_moves_and_nothing_else(model):
    effect = BodyCentreOfMass(x=0.1, y=0.2, z=-0.3)
    before, after = compile_model(spec(model)), compile_model(spec(model), [effect])
    np.testing.assert_allclose(after.body_ipos[1:] - before.body_ipos[1:], [[0.1, 0.2, -0.3]] * (before.nbody - 1))
    np.testing.assert_allclose(after.body_mass, before.body_mass, rtol=1e-9)
    for body in range(1, before.nbody):
        np.testing.assert_allclose(inertia_of(after, body), inertia_of(before, body), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_a_payload_is_what_a_small_heavy_ball_is(model):
    before = compile_model(spec(model))
    name = before.body(1).name
    after = compile_model(spec(model), [Payload(2.0, x=0.3, y=0.1, z=-0.2, bodies=name)])
    assert (after.nbody, after.ngeom) == (before.nbody, before.ngeom)
    np.testing.assert_allclose(after.body_mass.sum(), before.body_mass.sum() + 2.0, rtol=1e-9)
    # reference: the two masses as separate bodies welded together, with their common inertia at the joint
    welded = mujoco.MjSpec()
    root = welded.worldbody.add_body()
    root.add_freejoint()
    own = root.add_body(mass=before.body_mass[1], ipos=before.body_ipos[1], explicitinertial=True)
    own.inertia, own.iquat = before.body_inertia[1], before.body_iquat[1]
    root.add_body(mass=2.0, ipos=[0.3, 0.1, -0.2], inertia=[1e-9] * 3, explicitinertial=True)
    alone = mujoco.MjSpec()
    single = alone.worldbody.add_body(mass=after.body_mass[1], ipos=after.body_ipos[1], explicitinertial=True)
    single.inertia, single.iquat = after.body_inertia[1], after.body_iquat[1]
    single.add_freejoint()
    np.testing.assert_allclose(_mass_matrix(alone), _mass_matrix(welded), rtol=1e-6, atol=1e-7)


def _mass_matrix(spec: mujoco.MjSpec) -> np.ndarray:
    model = spec.compile()
    data, matrix = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, matrix)
    return matrix


def test_effects_on_the_inertial_compose_with_one_another():
    effects = [Payload(1.0, z=0.1, bodies="torso"), BodyMass(2.0, bodies="torso"), BodyInertia(0.5, bodies="torso")]
    before = compile_model(spec("HalfCheetah"))
    loaded = compile_model(spec("HalfCheetah"), effects[:1])
    after = compile_model(spec("HalfCheetah"), effects)
    assert after.body_mass[1] == pytest.approx(2.0 * (before.body_mass[1] + 1.0))
    np.testing.assert_allclose(after.body_mass[2:], before.body_mass[2:])
    np.testing.assert_allclose(inertia_of(after, 1), inertia_of(loaded, 1), rtol=1e-6, atol=1e-9)


def test_effects_on_geoms_come_before_those_on_inertials():
    larger = compile_model(spec("Walker2d"), [GeomSize(1.5, geoms="torso_geom")]).body_mass[1]
    loaded = compile_model(spec("Walker2d"), [GeomSize(1.5, geoms="torso_geom"), Payload(1.0, bodies="torso")])
    assert loaded.body_mass[1] == pytest.approx(larger + 1.0)


@pytest.mark.parametrize("model", MODELS)
def test_a_payload_without_mass_is_none_wherever_it_is(model):
    assert as_bytes(compile_model(spec(model), [Payload(0.0, x=1.0)])) == as_bytes(compile_model(spec(model)))


def test_a_payload_slows_a_pendulum_by_what_the_formula_says():
    pole = """<mujoco><option timestep="0.001"/><worldbody><body name="pole"><joint axis="0 1 0"/>
      <geom type="sphere" size="0.001" mass="1" pos="0 0 -1"/></body></worldbody></mujoco>"""

    def period(*effects) -> float:
        model = compile_model(mujoco.MjSpec.from_string(pole), effects)
        data = mujoco.MjData(model)
        data.qpos[0], crossings = 0.02, []
        while len(crossings) < 2:
            before = data.qpos[0]
            mujoco.mj_step(model, data)
            if before > 0.0 >= data.qpos[0]:
                crossings.append(data.time + model.opt.timestep * data.qpos[0] / (before - data.qpos[0]))
        return crossings[1] - crossings[0]

    # ω² = g Σ m l / Σ m l²
    assert period() == pytest.approx(2 * np.pi / np.sqrt(9.81), rel=1e-3)
    expected = 2 * np.pi / np.sqrt(9.81 * (1.0 + 3.0 * 2.0) / (1.0 + 3.0 * 4.0))
    assert period(Payload(3.0, z=-2.0)) == pytest.approx(expected, rel=1e-3)
    assert period(BodyCentreOfMass(z=-1.0)) == pytest.approx(2 * np.pi / np.sqrt(9.81 / 2.0), rel=1e-3)


CLOUD = """
<mujoco><worldbody><body name="cloud"><joint axis="0 1 0"/>{points}</body></worldbody></mujoco>"""
POINT = '<geom type="sphere" size="1e-4" mass="{mass}" pos="{x} {y} {z}"/>'


def cloud(masses: np.ndarray, points: np.ndarray) -> str:
    """A body of point masses, (n), at points, (n, 3)."""
    given = [POINT.format(mass=m, x=x, y=y, z=z) for m, (x, y, z) in zip(masses, points, strict=True)]
    return CLOUD.format(points="".join(given))


def test_a_pseudo_inertia_is_that_of_the_deformed_body():
    rng = np.random.default_rng(0)
    masses, points = rng.uniform(0.1, 1.0, 20), 0.3 * rng.standard_normal((20, 3))
    effect = PseudoInertia(0.2, 0.1, -0.2, 0.3, 0.4, -0.3, 0.2, 0.05, -0.02, 0.01)
    centre = masses @ points / masses.sum()
    stretch = np.array([[np.exp(0.1), 0.4, -0.3], [0.0, np.exp(-0.2), 0.2], [0.0, 0.0, np.exp(0.3)]])
    moved = (points - centre) @ stretch.T + centre + np.array([0.05, -0.02, 0.01])
    expected = compile_model(spec(cloud(np.exp(0.4) * masses, moved)))
    found = compile_model(spec(cloud(masses, points)), [effect])
    np.testing.assert_allclose(found.body_mass, expected.body_mass)
    np.testing.assert_allclose(found.body_ipos, expected.body_ipos, atol=1e-9)
    np.testing.assert_allclose(inertia_of(found, "cloud"), inertia_of(expected, "cloud"), rtol=1e-5)


def test_any_pseudo_inertia_is_possible():
    rng, xml = np.random.default_rng(0), CLOUD.format(points='<geom type="box" size=".1 .2 .3" mass="2"/>')
    for values in rng.uniform(-1.0, 1.0, (50, 10)):
        model = compile_model(spec(xml), [PseudoInertia(*values)])  # MuJoCo refuses impossible inertias
        a, b, c = np.sort(model.body("cloud").inertia)
        assert 0.0 < a <= b <= c <= (a + b) * (1.0 + 1e-9)
