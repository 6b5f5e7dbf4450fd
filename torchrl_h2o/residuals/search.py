"""Searches the set of effects with the best score: sweeps, linear algebra, refits of the best few sets."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from torchrl_h2o.effects import CatalogueEntry, Effect, ResidualForce, is_negligible
from torchrl_h2o.effects.catalogue.entry import entry_of
from torchrl_h2o.effects.catalogue.plausibility import is_outside, surprise
from torchrl_h2o.residuals.explanation import Alternative, Explanation, Part, Tried
from torchrl_h2o.residuals.forces.candidates import force_candidates
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.progress import EFFECTS, FORCES, OTHERS, LoopBar, OutOfTimeError
from torchrl_h2o.residuals.refit import fit_set, interval, slopes_of, variables_of
from torchrl_h2o.residuals.score import Difference, Model, Predictions
from torchrl_h2o.residuals.settings import DEFAULTS
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.sweep import Direction, Gains, Lead, sweep

ROUGH_STEPS = 2560  # physics steps that are simulated for each candidate of a sweep and in first fits
ROUGH_ROWS = 1024  # rows beyond which these are not more
RESWEPT = 64  # entries of the largest estimated gain, which are simulated again in later sweeps
TRIED = 8  # candidates of the largest estimated gain whose gain is then simulated
FITTED = 3  # of these, the best whose values are fitted
SKETCH = 3  # steps of such a fit
GROWN = 5  # steps of the fit of a set after an effect was added
REFITTED = 3  # fits of a set, each from the start states that the fit before gives
SWEEPS = 6  # largest number of sweeps
NATS_OF_SURPRISE = 2.0  # evidence that an effect needs for each degree of surprise
ALIKE = 3.0  # evidence, in nats, up to which two sets explain the data equally well
MANY = 2  # joints or motors with an effect beside which a further one needs hardly any evidence
ONE_MORE = 1.0  # that evidence
SURPRISE_OF_FORCE = 3  # surprise of a term of a force outside the catalogue
SURE = 3.0  # multiple of the evidence that an effect needs, beyond which an estimate of it is enough
MOST_KEPT = 3  # effects that were needed when they were dropped, after which no more are
MOST_REFUSED = 9  # candidates that are refused one after another before none is added
SWAPS = 4  # largest number of effects that are replaced by others
MOST_TERMS = 6  # largest number of terms of a force outside the catalogue
MOST_EFFECTS = 80  # largest number of entries in a set


def stop_test(level: float) -> str:
    """Description of the test by which the search for effects stops."""
    return (
        "log density of rows that no fit has used, predicted 1, 2, 4, ... rows ahead: a further effect must raise it, "
        f"paired over blocks of rows, by a likelihood ratio of {1.0 / level:.0f}, and more if it is unusual"
    )


def surprise_of(effects: Iterable[Effect]) -> int:
    """How unusual effects are in all: the most unusual of each kind counts, because joints resemble each other.

    Each term of a force that no effect of the catalogue describes counts by itself.
    """
    most: dict[type, int] = {}
    forces = 0
    for effect in effects:
        if isinstance(effect, ResidualForce):
            forces += SURPRISE_OF_FORCE * len(effect.terms)
        else:
            most[type(effect)] = max(surprise(effect), most.get(type(effect), 0))
    return sum(most.values()) + forces


@dataclass(frozen=True, eq=False)
class Found:
    """A set of effects with its score.

    Args:
        entries: entries of the catalogue.
        effects: the effects with their values.
        scores: scores of the blocks for fits and of those for selection, (F + S).
        one_step: scores of the blocks for selection one step ahead, (S), if they tell more than the sensors' noise.
    """

    entries: tuple[CatalogueEntry, ...]
    effects: tuple[Effect, ...]
    scores: np.ndarray
    one_step: np.ndarray | None = None

    @property
    def names(self) -> frozenset[str]:
        """Names of the entries."""
        return frozenset(entry.name for entry in self.entries)

    @property
    def surprise(self) -> int:
        """How unusual the effects are in all; see :func:`surprise_of`."""
        return surprise_of(self.effects)

    def without(self, names: Collection[str]) -> tuple[tuple[CatalogueEntry, ...], tuple[Effect, ...]]:
        """Entries and effects without some of them."""
        kept = [pair for pair in zip(self.entries, self.effects, strict=True) if pair[0].name not in names]
        return tuple(entry for entry, _ in kept), tuple(effect for _, effect in kept)


@dataclass(frozen=True, eq=False)
class Ground:
    """Compares sets, each by predictions from start states that are filtered with this set.

    Args:
        simulation: the simulator without effects.
        base: predictions of a set near those to compare, whose derivatives the filters of all sets use.
    """

    simulation: Simulation
    base: Model
    _models: dict[tuple[Effect, ...], Model] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, simulation: Simulation, measured: Measured, effects: Sequence[Effect] = ()) -> Ground:
        """The ground near a set of effects."""
        model = Model.of(simulation.with_effects(*effects), measured)
        counts = model.fit.effective_counts(model.fit.errors())
        base = Model(replace(model.fit, counts=counts), replace(model.selection, counts=counts))
        return cls(simulation, base, {tuple(effects): base})

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
        """As :meth:`fit_part` in some of the blocks, without the shortest windows."""
        part = self.model(effects).fit
        rows = min(ROUGH_ROWS, ROUGH_STEPS // self.simulation.frame_skip)
        rough = part.starts.rough(max(8, rows // part.blocks.steps))
        return Predictions(rough).of_simulation(self.simulation)

    def found(self, entries: Sequence[CatalogueEntry], effects: Sequence[Effect]) -> Found:
        """A set with its scores."""
        model = self.model(effects)
        return Found(tuple(entries), tuple(effects), model.scores(), model.one_step_ahead())

    def fitted(self, entries: Sequence[CatalogueEntry], effects: Sequence[Effect]) -> Found:
        """A set with its values fitted from the present ones."""
        found = self.found(entries, effects)
        for _ in range(REFITTED if entries else 0):
            fit = fit_set([self.fit_part(found.effects)], entries, found.effects, most_steps=GROWN)
            other = self.found(entries, fit.effects)
            gain = other.scores[: self.num_fit].mean() - found.scores[: self.num_fit].mean()
            found = other if gain > 0.0 else found
            if gain < 0.01 * len(self.simulation.state_map.names):
                break
        return found

    def sketched(self, part: Predictions, entries: Sequence[CatalogueEntry], effects: Sequence[Effect]) -> Found:
        """A set with its values fitted to predictions, such as rough ones, in a few steps."""
        return self.found(entries, fit_set([part], entries, effects, most_steps=SKETCH).effects if entries else ())

    def needed(self, more: Found, less: Found, level: float) -> float:
        """Evidence that a larger set needs: a significant one, and more for unusual effects.

        What several joints have, such as friction, further ones have too: these need hardly any evidence.
        """
        kinds = [type(effect) for effect in less.effects]
        added = [
            effect for entry, effect in zip(more.entries, more.effects, strict=True) if entry.name not in less.names
        ]
        if all(kinds.count(type(effect)) >= MANY for effect in added):
            return ONE_MORE
        return NATS_OF_SURPRISE * max(0, more.surprise - less.surprise) - math.log(level)

    def evidence(self, more: Found, less: Found) -> float:
        """Evidence of the rows for selection that one set predicts better than another."""
        return Difference((more.scores - less.scores)[self.num_fit :]).evidence

    def adds(self, more: Found, less: Found, level: float, among: int = 1) -> bool:
        """Whether a set predicts better than a smaller one, by more than its surprise.

        Rows for selection must show half of the evidence needed, and all rows must show all of it, and more where the
        set is the best of many.

        Noise in the commands moves the simulator and not the machine, and over many steps an effect predicts better
        that makes the simulator deaf to it, such as friction. Where such noise is larger than that of the sensors, an
        effect must therefore predict the next step better, too.
        """
        needed = self.needed(more, less, level)
        in_all = Difference(more.scores - less.scores).evidence
        if self.evidence(more, less) <= 0.5 * needed or in_all <= needed + math.log(among):
            return False
        if more.one_step is None or less.one_step is None:
            return True
        return Difference(more.one_step - less.one_step).evidence > 0.5 * min(needed, -math.log(level))


def grow(
    ground: Ground,
    found: Found,
    directions: Sequence[Direction],
    level: float,
    advance: Callable[[Found], object],
    tried: dict[str, Tried],
) -> Found:
    """Adds candidates one after another while the rows for selection are predicted better."""
    refused: set[frozenset[str]] = set()
    among = max(1, len({one.entry.name for one in directions}))
    while len(found.entries) < MOST_EFFECTS and len(refused) < MOST_REFUSED:
        fitted = _with_one_more(ground, found, directions, refused, -math.log(level))
        if not fitted:
            break
        for one in fitted:
            _remember(tried, one, found)
        better = [one for one in fitted if ground.adds(one, found, level, among)]
        if better:
            best = _most_usual(better)
            many = len(best.entries) > len(found.entries) + 2
            found, refused = ground.fitted(best.entries, best.effects), set()
            advance(found)
            if many:  # the errors now change with the candidates in other ways than at the sweep
                break
        else:
            refused |= {one.names - found.names for one in fitted}
    return found


def _remember(tried: dict[str, Tried], more: Found, less: Found) -> None:
    """Keeps an effect that was fitted beside others, with its evidence."""
    added = [pair for pair in zip(more.entries, more.effects, strict=True) if pair[0].name not in less.names]
    if len(added) == 1 and not isinstance(added[0][1], ResidualForce):
        tried[added[0][0].name] = Tried(*added[0], Difference(more.scores - less.scores).evidence)


def with_force(
    ground: Ground, found: Found, catalogue: Sequence[CatalogueEntry], level: float, advance: Callable[[Found], object]
) -> Found:
    """Adds terms of a force outside the catalogue while the rows for selection are predicted better."""
    for _ in range(MOST_TERMS):
        starts = ground.model(found.effects).fit.starts
        rows, states = starts.of_rows
        rough = ground.rough(found.effects)
        simulation = starts.record.simulation
        sets = []
        for pairs in force_candidates(simulation, starts.record.measured, states, rows, catalogue):
            new = [pair for pair in pairs if pair[0].name not in found.names]
            if new:
                entries = (*found.entries, *(entry for entry, _ in new))
                effects = (*found.effects, *(effect for _, effect in new))
                sets.append((rough.score(effects), entries, effects))
        best = sorted(sets, key=lambda one: -one[0])[:FITTED]
        fitted = [ground.sketched(rough, entries, effects) for _, entries, effects in best]
        better = [one for one in fitted if ground.adds(one, found, level, max(1, len(sets)))]
        if not better:
            break
        best_one = _most_usual(better)
        found = ground.fitted(best_one.entries, best_one.effects)
        advance(found)
    return found


def _with_one_more(
    ground: Ground,
    found: Found,
    directions: Sequence[Direction],
    passed_over: Collection[frozenset[str]] = (),
    least: float = 0.0,
) -> list[Found]:
    """The set with each of the few best candidates, whose values are fitted in a few steps."""
    rough = ground.rough(found.effects)
    gains = _gains(rough, found)
    leads = [
        lead
        for lead in _best_of_each(gains.leads(directions))
        if lead.names not in passed_over and not lead.names <= found.names and lead.evidence > 0.5 * least
    ]
    tried = [one[1:] for one in sorted(_simulated(rough, found, leads[:TRIED]), key=lambda one: -one[0])[:FITTED]]
    joints = gains.of_joints(directions) if leads else None
    if joints is not None and joints.names not in passed_over and not joints.names <= found.names:
        tried.append(joints.beside(found.entries, found.effects, 1.0))
    fitted = []
    for entries, effects in tried:
        try:
            one = ground.sketched(rough, entries, effects)
        except ValueError:  # the model rejects the effects together
            continue
        if _is_usable(ground, one, found):
            fitted.append(one)
    return fitted


def _gains(part: Predictions, found: Found) -> Gains:
    """Gains of candidates beside a set, whose values are readjusted."""
    errors, beside = part.errors(found.effects), []
    if found.entries:
        variables = variables_of(part, found.entries, found.effects)
        beside = list(slopes_of([part], found.effects, variables, [errors])[0].T)
    return Gains.of(part, errors, beside)


def _best_of_each(leads: Sequence[Lead]) -> list[Lead]:
    """The best direction of each candidate, in descending order of the estimated gain."""
    best: dict[frozenset[str], Lead] = {}
    for lead in leads:
        best.setdefault(lead.names, lead)
    return list(best.values())


def _simulated(
    rough: Predictions, found: Found, leads: Sequence[Lead]
) -> list[tuple[float, tuple[CatalogueEntry, ...], tuple[Effect, ...]]]:
    """Score on the rows for fits, entries and effects of each lead beside the present set, at the best of few sizes."""
    results = []
    for lead in leads:
        best = None
        for factor in dict.fromkeys((1.0, 0.5, 1.0 / max(abs(share) for share in lead.shares))):
            entries, effects = lead.beside(found.entries, found.effects, factor)
            try:
                score = rough.score(effects)
            except ValueError:
                continue
            if best is None or score > best[0]:
                best = (score, entries, effects)
        if best is not None:
            results.append(best)
    return results


def _is_usable(ground: Ground, found: Found, before: Found) -> bool:
    return not any(
        is_negligible(effect, entry.trials) or is_outside(effect, ground.simulation.model)
        for entry, effect in zip(found.entries, found.effects, strict=True)
        if entry.name not in before.names and len(found.names - before.names) == 1
    )


def _most_usual(sets: Sequence[Found]) -> Found:
    """The best set, or the most usual and smallest one of those that are not significantly worse."""
    best = max(sets, key=lambda one: one.scores.mean())
    alike = [one for one in sets if Difference(best.scores - one.scores).evidence < ALIKE]
    return min([best, *alike], key=lambda one: (one.surprise, len(one.entries), -one.scores.mean()))


def prune(ground: Ground, found: Found, level: float) -> Found:
    """Drops effects without which the rows for selection are predicted as well, the least needed ones first."""
    before, kept = found, set[str]()
    pairs = zip(found.entries, found.effects, strict=True)
    if idle := {entry.name for entry, effect in pairs if is_negligible(effect, entry.trials)}:
        found = ground.found(*found.without(idle))
    found = _without_needless_kinds(ground, found, level)
    while found.names - kept and len(kept) < MOST_KEPT:
        estimates = [one for one in _estimates(ground.fit_part(found.effects), found) if one[0] not in kept]
        cost = {name: ground.needed(found, Found(*found.without({name}), found.scores), level) for name, _ in estimates}
        weak = [name for name, estimate in estimates if estimate < 0.5 * cost[name]]
        if not weak and (open_ := [name for name, estimate in estimates if estimate < SURE * cost[name]]):
            weak = open_[:1]
        count = len(weak)
        while count:
            fewer = _fewer(ground, found, weak[:count])
            if fewer is not None and not ground.adds(found, fewer, level):
                found = fewer
                break
            count //= 2
        else:
            if not weak:
                break
            kept.add(weak[0])
    return found if found is before else ground.fitted(found.entries, found.effects)


def _without_needless_kinds(ground: Ground, found: Found, level: float) -> Found:
    """Drops an effect on all of its joints or motors if the rows for selection are predicted as well without it."""
    for kind in dict.fromkeys(map(type, found.effects)):
        same = {e.name for e, effect in zip(found.entries, found.effects, strict=True) if type(effect) is kind}
        if len(same) > 1:
            fewer = _fewer(ground, found, same)
            if fewer is not None and not ground.adds(found, fewer, level):
                found = fewer
    return found


def _fewer(ground: Ground, found: Found, dropped: Collection[str]) -> Found | None:
    """The set without some effects; None if the model rejects the others without these."""
    try:
        return ground.sketched(ground.fit_part(found.effects), *found.without(dropped))
    except ValueError:
        return None


def _estimates(part: Predictions, found: Found) -> list[tuple[str, float]]:
    """Effects in the order in which they may be dropped, with the estimated evidence of the rows for fits for each."""
    variables = variables_of(part, found.entries, found.effects)
    estimates = _gains(part, found).least_needed(variables)
    return [(found.entries[index].name, evidence) for index, evidence in estimates]


def replaced(
    ground: Ground, found: Found, directions: Sequence[Direction], advance: Callable[[], object]
) -> tuple[Found, list[list[Found]]]:
    """Replaces effects by better or more usual ones, and lists for each effect those that explain the data as well.

    The same effect on each of several joints or motors stays.
    """
    alike: list[list[Found]] = []
    swaps = 0
    while len(alike) < len(found.entries):
        advance()
        entry, effect = found.entries[len(alike)], found.effects[len(alike)]
        if sum(type(other) is type(effect) for other in found.effects) > 1:
            alike.append([])
            continue
        fewer = ground.found(*found.without({entry.name}))
        fitted = [
            ground.fitted(one.entries, one.effects)
            for one in _with_one_more(ground, fewer, directions, [frozenset({entry.name})])
            if 2.0 * (one.scores - fewer.scores).mean() > (found.scores - fewer.scores).mean()
        ]
        others = [one for one in fitted if Difference(found.scores - one.scores).evidence < ALIKE]
        better = [one for one in others if _is_preferred(one, found)]
        if better and swaps < SWAPS:
            found, alike, swaps = _most_usual(better), [], swaps + 1
        else:
            alike.append(sorted(others, key=lambda one: -one.scores.mean()))
    return found, alike


def _is_preferred(other: Found, found: Found) -> bool:
    """Whether a set explains the data better than another, or as well and by fewer or more usual effects."""
    evidence = Difference(other.scores - found.scores).evidence
    simpler = (other.surprise, len(other.entries)) < (found.surprise, len(found.entries))
    return evidence > ALIKE or (evidence > -ALIKE and simpler)


def search(
    simulation: Simulation,
    measured: Measured,
    catalogue: Sequence[CatalogueEntry],
    *,
    progress: LoopBar,
    known: Sequence[Effect] = (),
    so_far: Callable[[Explanation], object] = lambda found: None,
    level: float = DEFAULTS.level,
) -> Explanation:
    """Searches the effects with which a simulator predicts the data best.

    Args:
        simulation: the simulator.
        measured: the data.
        catalogue: effects that the simulator may lack; random ones are left out, because noise is part of the score.
            Forces that are none of them are tried as well, but need more evidence.
        progress: bar that shows how far the search is.
        known: effects of the catalogue from which the search begins.
        so_far: called with each better explanation.
        level: significance level at which an effect is added.

    Returns:
        The explanation, with the values fitted to the rows for fits and for selection; the one so far if the time of
        ``progress`` is up.

    Raises:
        OutOfTimeError: if the time of ``progress`` is up before there is a first result.
    """
    tried: dict[str, Tried] = {}
    latest = [_known(catalogue, known)]

    def better(found: Found) -> None:
        latest.append(found)
        if found.entries:
            progress.has_result()
        progress.show_found(found.entries)
        so_far(_explanation(found))

    ended_in, unseen, alike = None, (), []
    progress.stage(EFFECTS)
    ground = Ground.of(simulation, measured, latest[0].effects)
    try:
        ground, alike, unseen = _searched(ground, latest[0], catalogue, level, progress, better, tried)
    except OutOfTimeError as end:
        ended_in = str(end)
    found = latest[-1]
    progress.begin_last_fit(bool(found.entries))
    try:
        explanation = _explanation(*_with_intervals(ground, found), alike)
    except OutOfTimeError as end:
        explanation, ended_in = _explanation(found), ended_in or str(end)
    left = [one for name, one in tried.items() if name not in found.names]
    left.sort(key=lambda one: -one.evidence)
    return replace(explanation, tried=tuple(left), unseen=unseen, ended_in=ended_in)


def _known(catalogue: Sequence[CatalogueEntry], known: Sequence[Effect]) -> Found:
    pairs = [(entry_of(effect, catalogue), effect) for effect in known if not effect.random]
    there = [(entry, effect) for entry, effect in pairs if entry is not None]
    return Found(tuple(entry for entry, _ in there), tuple(effect for _, effect in there), np.zeros(0))


def _searched(
    ground: Ground,
    found: Found,
    catalogue: Sequence[CatalogueEntry],
    level: float,
    progress: LoopBar,
    better: Callable[[Found], object],
    tried: dict[str, Tried],
) -> tuple[Ground, list[list[Found]], tuple[Effect, ...]]:
    """Sweeps and grows, then drops and replaces, until nothing changes; hands each better set to ``better``."""
    every = [entry for entry in catalogue if not entry.effect.random]
    entries, directions, alike, unseen = every, [], [], ()
    measured = ground.base.fit.record.measured
    for number in range(SWEEPS):
        if number:
            ground = Ground.of(ground.simulation, measured, found.effects)
        found = ground.fitted(found.entries, found.effects)
        if number > 1:
            best = _best_of_each(_gains(ground.rough(found.effects), found).leads(directions))[:RESWEPT]
            chosen = found.names.union(*(lead.names for lead in best))
            entries = [entry for entry in every if entry.name in chosen]
        closer = partial(progress.closer, 0.5 / max(1, len(entries)))
        rough = ground.rough(found.effects)
        directions = sweep(rough, entries, found.effects, closer)
        if not number and not found.entries:
            unseen = _unseen(ground, rough, every, directions, level)
        before = found.names
        found = grow(ground, found, directions, level, better, tried)
        if found.names == before:
            progress.stage(FORCES)
            found = with_force(ground, found, every, level, better)
            if before and found.names != before:  # a force alone may explain what effects were found for
                alone = with_force(ground, ground.found((), ()), every, level, lambda _: None)
                if alone.entries and _is_preferred(alone, found):
                    found = alone
                    better(found)
        if found.names == before:
            progress.stage(OTHERS)
            found = prune(ground, found, level)
            better(found)
            found, alike = replaced(ground, found, directions, lambda: progress.closer(0.05))
            better(found)
            if found.names == before:
                break
    return ground, alike, () if found.entries else unseen


def _unseen(
    ground: Ground,
    rough: Predictions,
    entries: Sequence[CatalogueEntry],
    directions: Sequence[Direction],
    level: float,
) -> tuple[Effect, ...]:
    """Effects at their largest trials that these data would not show, the first of each kind before the others."""
    gains = _gains(rough, Found((), (), np.zeros(0)))
    seen: dict[str, float] = {entry.name: 0.0 for entry in entries}
    largest: dict[str, Effect] = {entry.name: entry.starts[-1] for entry in entries}
    blocks = len(ground.base.selection.blocks) / len(rough.blocks)
    for direction in directions:
        evidence = blocks * gains.evidence_if_there(direction)
        if evidence > seen[direction.entry.name]:
            seen[direction.entry.name] = evidence
            largest[direction.entry.name] = direction.entry.effect.with_parameters(direction.trial)
    needed = {name: NATS_OF_SURPRISE * surprise(effect) - math.log(level) for name, effect in largest.items()}
    missed = sorted((name for name in seen if seen[name] < needed[name]), key=lambda name: -seen[name])
    effects = [largest[name] for name in missed]
    first = {type(effect): effect for effect in reversed(effects)}
    return tuple(sorted(effects, key=lambda effect: effect is not first[type(effect)]))


def _with_intervals(ground: Ground, found: Found) -> tuple[Found, Sequence[Mapping[str, float]]]:
    """A set fitted to the rows for fits and for selection, and the half-widths of its intervals."""
    model = ground.model(found.effects)
    parts = [part.of_simulation(ground.simulation) for part in (model.fit, model.selection)]
    fit = fit_set(parts, found.entries, found.effects, most_steps=GROWN, intervals=True)
    return replace(found, effects=fit.effects), fit.half_widths


def _explanation(
    found: Found, half_widths: Sequence[Mapping[str, float]] = (), alike: Sequence[Sequence[Found]] = ()
) -> Explanation:
    """The explanation by a set; the terms of forces are put together, at its end."""
    parts, forces = [], []
    for index, effect in enumerate(found.effects):
        half = half_widths[index] if half_widths else {}
        ci95 = {name: interval(effect.parameters[name], width) for name, width in half.items()}
        if isinstance(effect, ResidualForce):
            forces.append((effect, ci95))
            continue
        others = alike[index] if index < len(alike) else ()
        parts.append(Part(effect, True, ci95, tuple(map(_alternative, others))))
    if forces:
        terms = tuple(term for effect, _ in forces for term in effect.terms)
        ci95 = {
            f"{name.rsplit('_', 1)[0]}_{index}": ends
            for index, (_, own) in enumerate(forces, start=1)
            for name, ends in own.items()
        }
        parts.append(Part(ResidualForce(terms), False, ci95))
    return Explanation(tuple(parts))


def _alternative(other: Found) -> Alternative:
    return Alternative(other.effects[-1], tuple((effect, {}) for effect in other.effects))
