"""Thresholds and trial values of the effects package, as one documented settings object."""

from dataclasses import dataclass


@dataclass(frozen=True)
class EffectSettings:
    """Thresholds of :func:`~torchrl_h2o.effects.balanced` and sizes of :func:`~torchrl_h2o.effects.catalogue`.

    Args:
        noise_excess: share of the variance by which negative noise may exceed the noise before it. A fitted standard
            deviation is rarely exact, so a slight excess removes all of the noise instead of raising an error.
        noise_rounding: share of the variance below which the remaining noise is set to zero.
        lever: lever arm in m. The weight times this lever is the typical torque on a hinge without an actuator.
        factors: scales that a trial multiplies a property of the model by.
        aligned: deviation of a direction cosine from 0 or 1 below which a joint's axis is perpendicular or parallel
            to the y axis.
        large_factor: factor beyond which a wrong property of the model is surprising; see
            :func:`~torchrl_h2o.effects.catalogue.plausibility.surprise`.
        late: delay or time constant of a drive or a sensor, in s, beyond which it is surprising.
        inertia_change: relative change of a body's inertia above which a geom contributes to it.
    """

    noise_excess: float = 0.01
    noise_rounding: float = 1e-9
    lever: float = 0.1
    factors: tuple[float, ...] = (0.5, 0.8, 1.25, 2.0)
    aligned: float = 1e-3
    inertia_change: float = 1e-9
    large_factor: float = 2.0
    late: float = 0.3


EFFECT_SETTINGS = EffectSettings()
