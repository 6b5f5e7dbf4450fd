"""An entry of a catalogue: a candidate effect with initial values for its fit."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from torchrl_h2o.effects.effect import Effect
from torchrl_h2o.effects.selection import Indices, Names

Trials = tuple[dict[str, float], ...]


@dataclass(frozen=True)
class CatalogueEntry:
    """A candidate effect at its neutral value, with the initial values of its fit.

    Args:
        effect: the neutral effect, with its selection filled in.
        trials: initial values of the fitted parameters by name, the same parameters in every trial. All other
            parameters keep their neutral values.

    Raises:
        ValueError: if the effect is not neutral, or there are no trials, or they name different parameters.

    Examples:
        >>> from torchrl_h2o.effects import BodyMass
        >>> entry = CatalogueEntry(BodyMass(bodies="torso"), trials=({"scale": 0.5}, {"scale": 2.0}))
        >>> entry.name, [effect.describe() for effect in entry.starts]
        ('BodyMass torso', ['mass of bodies torso × 0.5', 'mass of bodies torso × 2'])
    """

    effect: Effect
    trials: Trials

    def __post_init__(self):
        if not self.effect.is_neutral:
            raise ValueError(f"an entry starts from the neutral effect, not from {self.effect!r}")
        if len({frozenset(trial) for trial in self.trials}) != 1 or not self.fitted:
            raise ValueError(f"{self.name}: the trials {self.trials} must name the same parameters, at least one")
        for trial in self.trials:
            if not trial.keys() <= self.effect.parameters.keys():
                raise ValueError(f"{self.name} has the parameters {list(self.effect.parameters)}, not all of {trial}")

    @property
    def name(self) -> str:
        """The class of the effect and its selection: ``BodyMass torso``, ``ActionGain 3``, ``Gravity``."""
        fields = [f.name for f in dataclasses.fields(self.effect) if f.name not in self.effect.parameters]
        return " ".join([type(self.effect).__name__, *(_label(getattr(self.effect, field)) for field in fields)])

    @property
    def fitted(self) -> tuple[str, ...]:
        """The names of the fitted parameters."""
        return tuple(self.trials[0])

    @property
    def starts(self) -> tuple[Effect, ...]:
        """The effect with the values of each trial."""
        return tuple(self.effect.with_parameters(trial) for trial in self.trials)


def entry_of(effect: Effect, catalogue: Sequence[CatalogueEntry]) -> CatalogueEntry | None:
    """The entry with the same effect at its neutral value; None if the catalogue has none."""
    neutral = effect.with_parameters({name: p.neutral for name, p in effect.parameters.items()})
    return next((entry for entry in catalogue if entry.effect == neutral), None)


def entries_of(
    effect: type[Effect],
    field: str,
    choices: Mapping[Names, tuple[int, ...]] | Mapping[Indices, tuple[int, ...]],
    trials: Callable[[tuple[int, ...]], Trials],
) -> Iterator[CatalogueEntry]:
    """Yields one entry per selection of elements that an effect acts on.

    Args:
        effect: the class of the effect.
        field: the field of the effect that holds the selection.
        choices: the selected indices, by selection.
        trials: returns the trials for selected indices. Their values are clipped to the bounds of the effect; a
            selection without trials gives no entry.

    Yields:
        The entries.
    """
    for chosen, indices in choices.items():
        neutral = effect(**{field: chosen})
        bounds = {name: parameter.bounds for name, parameter in neutral.parameters.items()}
        within = tuple(
            {name: min(max(float(value), bounds[name][0]), bounds[name][1]) for name, value in trial.items()}
            for trial in trials(indices)
        )
        if within:
            yield CatalogueEntry(neutral, within)


def each(parameter: str, *values: float) -> Trials:
    """Returns one trial per value of a single parameter."""
    return tuple({parameter: value} for value in values)


def _label(selected: str | tuple | None) -> str:
    if selected is None or selected == "*":
        return "all"
    return selected if isinstance(selected, str) else ", ".join(map(str, selected))
