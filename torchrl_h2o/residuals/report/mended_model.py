"""Writes ``mended.xml``: the simulator's model with all effects that MJCF can hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from torchrl_h2o.effects import Effect
from torchrl_h2o.effects.mjcf import put_into_spec, write_mjcf
from torchrl_h2o.residuals.report.words import effect_words
from torchrl_h2o.residuals.simulation.simulation import Simulation

FILE = "mended.xml"
REMEDY = (
    "Report.load(folder).mended(env) puts all effects into an env of the original model, and mend=report.json does "
    "it in a training; a simulation of mended.xml lacks only these: DynamicsGap(*report.mended_model.effects)"
)


@dataclass(frozen=True)
class LeftOut:
    """An effect that MJCF cannot hold.

    Args:
        effect: the effect.
        reason: the reason, as a clause.
        words: description with units; by default the effect's own.
    """

    effect: Effect
    reason: str
    words: str = ""

    def __post_init__(self):
        if not self.words:
            object.__setattr__(self, "words", effect_words(self.effect))


@dataclass(frozen=True)
class MendedModel:
    """The MJCF file with the effects of a report, and the effects that it does not contain.

    Args:
        file: name of the file in the report's folder; None if it could not be written.
        left_out: the effects that are not in it, those of the simulator before the report among them.
        failure: reason why there is no file.
    """

    file: str | None
    left_out: tuple[LeftOut, ...] = ()
    failure: str | None = None

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects that a simulation of the file still lacks, in their order."""
        return tuple(left.effect for left in self.left_out)


def save_mended_model(simulation: Simulation, effects: Sequence[Effect], folder: str | Path) -> MendedModel:
    """Writes ``mended.xml``: the model of a simulation with the simulation's own effects and further ones.

    The file holds model effects, and gain, offset and saturation of actuators whose force is linear in their control.
    A simulation of the file with the effects that were left out predicts what the simulation with all effects does.

    Args:
        simulation: the simulation without the further effects.
        effects: the effects that it lacks.
        folder: created if it does not exist; meshes and textures are copied into it.

    Returns:
        The name of the file and the effects that are not in it. If the model cannot be written, an earlier file stays,
        and all effects are left out.

    Examples:
        >>> import tempfile
        >>> from torchrl_h2o.effects import ActionDelay, Gravity
        >>> from torchrl_h2o.envs import WheelLeggedEnv
        >>> simulation = Simulation.from_env(WheelLeggedEnv())
        >>> mended = save_mended_model(simulation, [Gravity(0.9), ActionDelay(0.004)], tempfile.mkdtemp())
        >>> mended.file, [left.words for left in mended.left_out]
        ('mended.xml', ['all actuators late by 0.004 s'])
    """
    every = (*simulation.effects, *effects)
    try:
        spec = simulation.spec()
        left_out = tuple((left.effect, left.reason) for left in put_into_spec(spec, every))
        write_mjcf(spec, Path(folder) / FILE)
    except (ValueError, OSError) as error:  # the report is worth more than this file
        lacking = tuple((effect, "there is no file") for effect in every if not effect.is_neutral)
        return MendedModel(None, _described(simulation, lacking), str(error))
    return MendedModel(FILE, _described(simulation, left_out))


def _described(simulation: Simulation, left_out: Sequence[tuple[Effect, str]]) -> tuple[LeftOut, ...]:
    return tuple(LeftOut(effect, reason, effect_words(effect, simulation.names)) for effect, reason in left_out)
