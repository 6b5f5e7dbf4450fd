"""Sets of effects with their scores, and the ground on which they are compared."""

from __future__ import annotations

import math
from collections.abc import Collection, Hashable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from torchrl_h2o.effects import ActionBias, CatalogueEntry, Effect, JointForce, ObservationBias, ResidualForce
from torchrl_h2o.effects.catalogue.plausibility import surprise
from torchrl_h2o.likelihood import ENOUGH, Difference
from torchrl_h2o.residuals.command_noise import expected_commands
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.refit import fit_set
from torchrl_h2o.residuals.score import Model, Predictions
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.start_states import ROUNDING

ROUGH_WORK = 24_000  # physics steps times degrees of freedom that are simulated for each candidate of a sweep
ROUGH_ROWS = 1024  # rows beyond which these are not more, unless that suffices for all
FITTED = 3  # candidates whose values are fitted
SKETCH = 3  # steps of such a fit
GROWN = 5  # steps of the fit of a set after an effect was added
REFITTED = 3  # fits of a set, each from the start states that the fit before gives
NATS_OF_SURPRISE = 2.0  # evidence that an effect needs for each degree of surprise
MATTERS = 0.03  # share of the errors without effects, or of the motion if less, below which errors are not explained
NEARLY_NONE = 10.0  # roundings of a reading up to which an error is none
MANY = 2  # joints or motors with an effect beside which a further one needs hardly any evidence
ONE_MORE = 1.0  # that evidence
OWN = (ResidualForce, JointForce, ActionBias, ObservationBias)  # effects of which joints do not resemble each other
SURPRISE_OF_FORCE = 3  # surprise of a term of a force outside the catalogue


def kind_of(effect: Effect) -> Hashable:
    """What effects on several joints have in common; a force or an offset has nothing in common with others."""
    return effect if isinstance(effect, OWN) else type(effect)


def surprise_of(effects: Iterable[Effect]) -> int:
    """How unusual effects are in all: the most unusual of each kind counts, because joints resemble each other."""
    most: dict[Hashable, int] = {}
    for effect in effects:
        own = SURPRISE_OF_FORCE * len(effect.terms) if isinstance(effect, ResidualForce) else surprise(effect)
        most[kind_of(effect)] = max(own, most.get(kind_of(effect), 0))
    return sum(most.values())


@dataclass(frozen=True, eq=False)
class Found:
    """A set of effects with its score.

    Args:
        entries: entries of the catalogue.
        effects: the effects with their values.
        scores: scores of the blocks for fits and of those for selection, (F + S).
        one_step: scores of all blocks one step ahead, (F + S), and those with noisy logged commands.
        is_noise: whether these errors are noise of the motion or of the logged commands.
        slopes: estimated derivatives of the errors on the rows for fits by its values, (N, p), if there are any.
    """

    entries: tuple[CatalogueEntry, ...]
    effects: tuple[Effect, ...]
    scores: np.ndarray
    one_step: Sequence[np.ndarray] = ()
    is_noise: bool = False
    slopes: np.ndarray | None = field(default=None, repr=False)

    @property
    def names(self) -> frozenset[str]:
        """Names of the entries."""
        return frozenset(entry.name for entry in self.entries)

    @property
    def surprise(self) -> int:
        """How unusual the effects are in all; see :func:`surprise_of`. Each further value of an effect counts one."""
        return surprise_of(self.effects) + sum(len(entry.fitted) - 1 for entry in self.entries)

    @property
    def unusual(self) -> tuple[int, int, int]:
        """Surprise, number of entries, and of those on a single joint, motor or geom: these resemble each other."""
        chosen = [
            next((getattr(one, name) for name in ("joints", "actuators", "geoms") if hasattr(one, name)), None)
            for one in self.effects
        ]
        single = [which for which in chosen if which is not None and "*" not in str(which)]
        return self.surprise, len(self.entries), len(single)

    def without(self, names: Collection[str]) -> tuple[tuple[CatalogueEntry, ...], tuple[Effect, ...]]:
        """Entries and effects without some of them."""
        kept = [pair for pair in zip(self.entries, self.effects, strict=True) if pair[0].name not in names]
        return tuple(entry for entry, _ in kept), tuple(effect for _, effect in kept)


@dataclass(frozen=True, eq=False)
class Ground:
    """Compares sets, each by predictions from start states that are filtered with this set.

    Args:
        simulation: the simulator without effects.
        base: predictions of a set near those to compare; the filters of all sets use most of its derivatives.
        logged: the data with the logged commands, if these have noise.
    """

    simulation: Simulation
    base: Model
    logged: Measured | None = None
    _models: dict[tuple[Effect, ...], Model] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, simulation: Simulation, measured: Measured, effects: Sequence[Effect] = ()) -> Ground:
        """The ground near a set of effects, with the logged commands.

        Args:
            simulation: the simulator without effects.
            measured: the data.
            effects: the set.
        """
        model = Model.of(simulation.with_effects(*effects), measured)
        errors = model.of_simulation(simulation).fit.errors() if effects else model.fit.errors()
        motion = (_usual(change) for change in model.fit.changes)
        # a reading may rest in most windows
        sizes = (np.minimum(_usual(e), np.where(m > 0.0, m, math.inf)) for e, m in zip(errors, motion, strict=True))
        floor = np.concatenate([(MATTERS * size) ** 2 for size in sizes])
        base = _weighted(model, floor)
        return cls(simulation, base, None, {tuple(effects): base})

    def near(self, found: Found, measured: Measured) -> tuple[Ground, Found]:
        """The ground near a set that was found, and the set fitted to the commands that make its readings likeliest.

        The expected commands take the place of logged ones if the set, fitted to each, predicts significantly better.

        Args:
            found: the set.
            measured: the data with the logged commands.
        """
        simulation = self.simulation.with_effects(*found.effects)
        base = _weighted(Model.of(simulation, measured), self.base.fit.floor)
        best = logged = replace(self, base=base, logged=None, _models={found.effects: base})
        highest = first = logged.refit(found)
        for expected in expected_commands(measured):
            model = base.of_simulation(simulation, expected)
            other = replace(self, base=model, logged=measured, _models={found.effects: model})
            if (own := other.refit(found)).scores.mean() <= highest.scores.mean():
                break
            best, highest = other, own
        is_better = Difference(highest.scores - first.scores).evidence > ENOUGH
        return (best, highest) if is_better else (logged, first)

    @property
    def num_fit(self) -> int:
        """Number of blocks for fits."""
        return len(self.base.fit.blocks)

    def model(self, effects: Sequence[Effect]) -> Model:
        """Predictions from start states filtered with effects."""
        key = tuple(effects)
        if key not in self._models:
            while len(self._models) > 2 * FITTED:
                del self._models[next(iter(self._models))]
            self._models[key] = self.base.of_simulation(self.simulation.with_effects(*key))
        return self._models[key]

    def fit_part(self, effects: Sequence[Effect]) -> Predictions:
        """Predictions of the simulator without effects, on the rows for fits, from start states filtered with some."""
        return self.model(effects).fit.of_simulation(self.simulation)

    def rough(self, effects: Sequence[Effect]) -> Predictions:
        """As :meth:`fit_part`; for slow models in some of the blocks, without the shortest windows."""
        part, blocks = self.model(effects).fit, self.base.fit.blocks
        most = ROUGH_WORK // (self.simulation.frame_skip * self.simulation.model.nv)
        if len(blocks.windows) * len(blocks) * blocks.steps <= most:
            return part.of_simulation(self.simulation)
        own = Predictions(part.starts.rough(max(8, min(ROUGH_ROWS, most) // blocks.steps)), floor=part.floor)
        return replace(own, counts=own.effective_counts(own.errors())).of_simulation(self.simulation)

    def found(self, entries: Sequence[CatalogueEntry], effects: Sequence[Effect]) -> Found:
        """A set with its scores."""
        model = self.model(effects)
        one_step, is_noise = model.one_step_ahead()
        both = [one_step]
        if self.logged is not None:
            both.append(model.with_commands(self.logged).one_step_ahead()[0])
        return Found(tuple(entries), tuple(effects), model.scores(), both, is_noise or len(both) > 1)

    def leaves_little(self, found: Found) -> bool:
        """Whether all errors left are too small to matter, at all horizons; see ``MATTERS``."""
        floor = self.base.fit.floor
        if floor is None or not found.entries:
            return False
        errors = self.model(found.effects).fit.errors()
        usual = np.concatenate(list(map(_usual, errors)))
        return bool((usual**2 <= floor + (NEARLY_NONE * ROUNDING) ** 2).all())

    def fitted(self, entries: Sequence[CatalogueEntry], effects: Sequence[Effect]) -> Found:
        """A set with its values fitted from the present ones; a set that is not would lose to any larger one."""
        found = self.found(entries, effects)
        for _ in range(REFITTED if entries else 0):
            other = self.sketched(self.fit_part(found.effects), entries, found.effects, GROWN)
            gain = other.scores[: self.num_fit].mean() - found.scores[: self.num_fit].mean()
            found = other if gain > 0.0 else replace(found, slopes=other.slopes)
            if gain < 0.01 * len(self.simulation.state_map.names):
                break
        return found

    def refit(self, found: Found) -> Found:
        """A set of another ground with its values fitted in a few steps."""
        part = self.fit_part(found.effects)
        return self.sketched(part, found.entries, found.effects, SKETCH, found.slopes)

    def sketched(
        self,
        part: Predictions,
        entries: Sequence[CatalogueEntry],
        effects: Sequence[Effect],
        most_steps: int,
        slopes: np.ndarray | None = None,
    ) -> Found:
        """A set with its values fitted to predictions in a few steps.

        Args:
            part: the predictions.
            entries: entries of the catalogue.
            effects: the effects.
            most_steps: largest number of steps.
            slopes: derivatives of the errors by the first values, (N, q), if they are known.
        """
        if not entries:
            return self.found((), ())
        fit = fit_set([part], entries, effects, most_steps=most_steps, slopes=None if slopes is None else [slopes])
        return replace(self.found(entries, fit.effects), slopes=fit.slopes[0])

    def needed(self, more: Found, less: Found) -> float:
        """Evidence that a larger set needs: a significant one, and more for unusual effects.

        What several joints have, such as friction, further ones have too: these need hardly any evidence.
        """
        kinds = [kind_of(effect) for effect in less.effects]
        added = [
            effect for entry, effect in zip(more.entries, more.effects, strict=True) if entry.name not in less.names
        ]
        if all(kinds.count(kind_of(effect)) >= MANY for effect in added):
            return ONE_MORE
        return NATS_OF_SURPRISE * max(0, more.surprise - less.surprise) + ENOUGH

    def adds(self, more: Found, less: Found, among: int = 1) -> bool:
        """Whether a set predicts better than a smaller one, by more than its surprise.

        It must predict the rows for selection better, which chose none of its values, and all rows together must show
        the evidence needed, and more where the set is the best of many.

        Noise of the logged commands moves the simulator and not the machine, and noise of the motion the machine alone.
        Over many steps an effect then predicts better that makes the simulator deaf to it, such as damping. Where there
        is such noise, the next step must therefore show the evidence needed, too, with the expected commands and the
        logged ones.
        """
        needed = self.needed(more, less)
        is_shown = Difference(more.scores - less.scores).evidence > needed + math.log(among)
        return is_shown and self.agrees(more, less, needed)

    def agrees(self, more: Found, less: Found, needed: float = 0.0) -> bool:
        """Whether the rows for selection speak for a set and, where there is noise, the next rows by some evidence."""
        if Difference((more.scores - less.scores)[self.num_fit :]).evidence <= 0.0:
            return False
        return not less.is_noise or all(
            Difference(one - other).evidence > needed for one, other in zip(more.one_step, less.one_step, strict=True)
        )


def _usual(errors: np.ndarray) -> np.ndarray:
    """Median size of errors (W, h, n) by horizon and reading, (h, n), of those that are known."""
    return np.nanmedian(np.abs(errors), axis=0)


def _weighted(model: Model, floor: np.ndarray | None) -> Model:
    """A model whose errors count by their correlation in neighbouring windows, and not below a floor."""
    counts = model.fit.effective_counts(model.fit.errors())
    fit, selection = (replace(part, counts=counts, floor=floor) for part in (model.fit, model.selection))
    return Model(fit, selection)
