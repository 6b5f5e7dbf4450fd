"""Compiles a MuJoCo specification with the edits of model effects."""

import threading
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import mujoco
import numpy as np

from torchrl_h2o.effects.effect import Effect, ModelEffect


def compile_model(spec: mujoco.MjSpec, effects: Iterable[Effect] = ()) -> mujoco.MjModel:
    """Edits a specification with the model effects in their order, then compiles it once.

    Args:
        spec: the specification, edited in place.
        effects: effects of any kind; only model effects are applied.

    Returns:
        The compiled model.

    Raises:
        ValueError: if the model has no element that one of the effects could act on.

    Examples:
        >>> import mujoco
        >>> from torchrl_h2o.effects import Gravity
        >>> compile_model(mujoco.MjSpec(), [Gravity(2.0)]).opt.gravity
        array([  0.  ,   0.  , -19.62])
    """
    edit_spec(spec, effects)
    with accepting_total_mass():
        return spec.compile()


_FILTERS = threading.Lock()  # the filters of warnings belong to all threads


@contextmanager
def accepting_total_mass() -> Iterator[None]:
    """Suppresses the warning about ``settotalmass``, which Gymnasium's HalfCheetah file uses; one thread at a time."""
    with _FILTERS, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "compiler attribute 'settotalmass' is deprecated")  # not the user's file
        yield


def edit_spec(spec: mujoco.MjSpec, effects: Iterable[Effect]) -> None:
    """Edits a specification in place with the model effects in their order, without compiling it.

    Args:
        spec: the specification.
        effects: effects of any kind; only model effects are applied.

    Raises:
        ValueError: if the model has no element that one of the effects could act on.
    """
    for effect in effects:
        if isinstance(effect, ModelEffect):
            try:
                effect.edit(spec)
            except ValueError as error:
                raise ValueError(
                    f"{type(effect).__name__} ({effect.describe()}) cannot be put into model "
                    f"'{spec.modelname}': {error}"
                ) from error


def with_small_textures(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Gives each texture of a specification one plain pixel, in place: to draw textures takes most of a compilation.

    Args:
        spec: the specification of a model that is simulated but not rendered.

    Examples:
        >>> import mujoco
        >>> sky = "<texture name='sky' type='skybox' builtin='flat' width='800' height='800'/>"
        >>> spec = mujoco.MjSpec.from_string(f"<mujoco><asset>{sky}</asset></mujoco>")
        >>> with_small_textures(spec).compile().ntexdata
        18
    """
    for texture in spec.textures:
        texture.file, texture.cubefiles, texture.content_type = "", [""] * 6, ""
        texture.builtin, texture.mark = mujoco.mjtBuiltin.mjBUILTIN_FLAT, mujoco.mjtMark.mjMARK_NONE
        texture.width = texture.height = 1
    return spec


def require_changes(spec: mujoco.MjSpec, effects: Iterable[Effect]) -> None:
    """Checks that every model effect changes the model, in its place in the list.

    Args:
        spec: the specification, edited in place.
        effects: effects of any kind; neutral effects are allowed.

    Raises:
        ValueError: naming the first effect that changes nothing, such as a scale on a gravity of zero.

    Examples:
        >>> from torchrl_h2o.effects import Gravity
        >>> weightless = mujoco.MjSpec.from_string("<mujoco model='arm'><option gravity='0 0 0'/></mujoco>")
        >>> require_changes(weightless, [Gravity(2.0)])
        Traceback (most recent call last):
        ...
        ValueError: Gravity (gravity × 2) changes nothing in model 'arm': what it alters is zero or absent there; ...
    """
    before = saved_model(compile_model(spec.copy()))
    for effect in effects:
        if isinstance(effect, ModelEffect) and not effect.is_neutral:
            edit_spec(spec, [effect])
            after = saved_model(compile_model(spec.copy()))
            if after == before:
                raise ValueError(
                    f"{type(effect).__name__} ({effect.describe()}) changes nothing in model '{spec.modelname}': what "
                    "it alters is zero or absent there; leave it out or choose another effect"
                )
            before = after


def saved_model(model: mujoco.MjModel) -> bytes:
    """Returns a compiled model as bytes; equal models have equal bytes."""
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()
