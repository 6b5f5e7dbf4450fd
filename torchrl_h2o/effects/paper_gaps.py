"""The nine dynamics gaps of the H2O+ paper, as a table by name.

Source: Niu, Ji, et al., H2O+ (2023), arXiv 2309.12716, simulation experiments; the strengths are those of the
authors' published code.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from torchrl_h2o.effects.action.signal import ActionNoise
from torchrl_h2o.effects.effect import Effect
from torchrl_h2o.effects.model.geom import GeomFriction, GeomLength, GeomSize
from torchrl_h2o.effects.model.joint import JointRange, JointStiffness
from torchrl_h2o.effects.model.world import Gravity


@dataclass(frozen=True)
class PaperGap:
    """One of the paper's gaps.

    Args:
        effect: builds the effect from a strength, which becomes the value of the effect's first parameter.
        strength: the paper's strength.
        tasks: the tasks in which the paper uses the gap.
    """

    effect: Callable[[float], Effect]
    strength: float
    tasks: tuple[str, ...] = ("HalfCheetah", "Walker2d")


# "*thigh*/*" selects the joints of the thigh bodies by the body's name, because joint names differ between tasks.
PAPER_GAPS: Mapping[str, PaperGap] = MappingProxyType(
    {
        "gravity": PaperGap(Gravity, 2.0),
        "friction": PaperGap(GeomFriction, 0.3),
        "joint_noise": PaperGap(ActionNoise, 1.0),
        "big_thigh": PaperGap(lambda scale: GeomSize(scale, geoms="*thigh*"), 2.0),
        "small_thigh": PaperGap(lambda scale: GeomSize(scale, geoms="*thigh*"), 0.5),
        "broken_thigh": PaperGap(lambda scale: JointRange(scale, joints="*thigh*/*"), 0.5),
        "flexible_thigh": PaperGap(lambda scale: JointRange(scale, joints="*thigh*/*"), 2.0),
        "long_torso": PaperGap(lambda scale: GeomLength(scale, geoms="torso"), 4.0, tasks=("HalfCheetah",)),
        "soft_feet": PaperGap(lambda scale: JointStiffness(scale, joints="*foot*/*"), 0.0, tasks=("HalfCheetah",)),
    }
)


def paper_gap(name: str, strength: float | None = None) -> Effect:
    """Builds the effect of one of the paper's gaps.

    The changes equal the authors' text edit of the task's MJCF with one exception: in Walker2d their edit of ``range``
    also changes the ``ctrlrange`` of the thighs' motors, whereas this effect changes only the joints' range.

    Args:
        name: ``gravity``, ``friction``, ``joint_noise``, ``big_thigh``, ``small_thigh``,
            ``broken_thigh``, ``flexible_thigh``, ``long_torso`` or ``soft_feet``.
        strength: the factor, or for ``joint_noise`` the standard deviation; the paper's value by default.

    Returns:
        The effect.

    Raises:
        ValueError: for an unknown gap or a strength outside the effect's bounds.

    Examples:
        >>> paper_gap("gravity").describe(), paper_gap("gravity", 1.5).describe()
        ('gravity × 2', 'gravity × 1.5')
    """
    if name not in PAPER_GAPS:
        raise ValueError(f"there is no gap named {name!r}; choose one of {', '.join(PAPER_GAPS)}")
    gap = PAPER_GAPS[name]
    return gap.effect(gap.strength if strength is None else strength)
