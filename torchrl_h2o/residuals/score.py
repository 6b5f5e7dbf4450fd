"""One score for every comparison: how probable the measured motion is, as predicted from earlier rows.

A simulation starts from the filtered state of a row and is compared with the readings 1, 2, 4, 8, ... control steps
later. The log density of an error is that of Student's t; its variance is the sum of the sensor's noise, of what the
uncertain start state makes of it, and of a variance for each horizon and reading. The last one is fitted to the errors
of the rows for fits and to those of the rows for selection, each by itself: where a machine moves faster, every
simulator is further off, and the better one must not pay for having smaller errors elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from torchrl_h2o.effects import Effect, ObservationEffect
from torchrl_h2o.likelihood import log_density
from torchrl_h2o.residuals.blocks import Blocks, block_steps
from torchrl_h2o.residuals.measured.residual import executed_actions, undelayed_following
from torchrl_h2o.residuals.measured.settling import activations
from torchrl_h2o.residuals.measured.transitions import Measured, Split
from torchrl_h2o.residuals.record import Record
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.start_states import ROUNDING, Noise, StartStates, filtered_rows

FIT_ROWS, SELECTION_ROWS = 1536, 1024  # rows that are predicted for fits, and for comparisons
FIT_BLOCKS, SELECTION_BLOCKS = 32, 24  # blocks of a long log for which more rows are predicted
DIVERGED = 1e3  # error in spreads where a simulation diverges
WHITE = 1.0 / 3.0  # correlation of successive errors up to which they count as independent noise
SCALED = 200  # windows from which these variances are fitted
SCALES = np.append(0.0, np.logspace(-3.0, 3.0, 25))  # tried variances, in squared median errors


@dataclass(frozen=True, eq=False)
class Predictions:
    """Predictions of windows by a simulation, with effects added.

    Args:
        starts: start states of the simulation without the added effects.
        counts: effective share of a window for each kind of windows and horizon, (h): windows of a block whose errors
            last count less; see :meth:`effective_counts`.
        floor: variance of errors that are too small to matter, (H, n) for the horizons 1, 2, 4, ...; none by default.
    """

    starts: StartStates
    counts: tuple[np.ndarray, ...] = ()
    floor: np.ndarray | None = None

    @cached_property
    def shares(self) -> tuple[np.ndarray, ...]:
        """Weight of each window in the score, by kind and horizon; by default, the windows of a block count as one."""
        blocks = self.blocks
        counts = self.counts or tuple(np.zeros(len(windows.horizons)) for windows in blocks.windows)
        return tuple(
            np.maximum(count, windows.steps / blocks.steps) / blocks.num_horizons
            for count, windows in zip(counts, blocks.windows, strict=True)
        )

    def effective_counts(self, errors: Sequence[np.ndarray]) -> tuple[np.ndarray, ...]:
        """Share of a window by which it counts beside the others of its block, (h) for each kind of windows.

        That is the variance that the mean error of a block would have if the errors were independent, over the variance
        that it has (batch means).
        """
        found = []
        for windows, error in zip(self.blocks.windows, errors, strict=True):
            size = np.median(np.abs(error), axis=0) + ROUNDING
            z = np.clip(error / size, -4.0, 4.0)
            number = self.blocks.steps // windows.steps
            means = z.reshape(len(self.blocks), number, *z.shape[1:]).mean(1)
            independent = (z**2).mean((0, 2)) / number
            found.append(np.minimum(independent / ((means**2).mean((0, 2)) + 1e-12), 1.0))
        return tuple(found)

    def likeness_of_neighbours(self, errors: Sequence[np.ndarray]) -> float:
        """Correlation of the errors one step ahead in successive windows, mean over the readings."""
        error, block = errors[0][:, 0], self.blocks.windows[0].block
        z = np.clip(error / (np.median(np.abs(error), axis=0) + ROUNDING), -4.0, 4.0)
        pairs = np.flatnonzero(block[1:] == block[:-1])
        return float((z[pairs] * z[pairs + 1]).mean() / ((z**2).mean() + 1e-12)) if len(pairs) else 0.0

    def of_simulation(self, simulation: Simulation, measured: Measured | None = None) -> Predictions:
        """The same windows from the same start states, predicted by another simulation, or with other commands."""
        own = self.record
        record = replace(own, simulation=simulation, measured=measured or own.measured)
        # unobserved coordinates stay those that the present simulation has reached
        record.__dict__["states"] = tuple(
            states + np.nan_to_num(new - old)
            for states, new, old in zip(own.states, record.read_states, own.read_states, strict=True)
        )
        record.__dict__["spread"] = own.spread
        return replace(self, starts=replace(self.starts, record=record))

    @cached_property
    def quick(self) -> Predictions:
        """The same windows by :attr:`Simulation.quick`, for derivatives."""
        quick = self.record.simulation.quick
        return self if quick is self.record.simulation else self.of_simulation(quick)

    @property
    def record(self) -> Record:
        """The log and the simulation."""
        return self.starts.record

    @property
    def blocks(self) -> Blocks:
        """The blocks that the windows are in."""
        return self.starts.blocks

    @cached_property
    def _states(self) -> list[np.ndarray]:
        return [self.starts.at(windows)[0] for windows in self.blocks.windows]

    @cached_property
    def _base(self) -> list[np.ndarray]:
        return self._predicted(self.record.simulation, self._states)

    def errors(self, effects: Sequence[Effect] = ()) -> list[np.ndarray]:
        """Measured minus predicted readings in spreads, (W, h, n) for each kind of windows, as the sensors report them.

        Raises:
            ValueError: if the model rejects an effect.
        """
        record, simulation = self.record, self.record.simulation
        if not effects:
            predicted = self._base
        else:
            simulation, states = record.simulation.with_effects(*effects), self._states
            if any(isinstance(effect, ObservationEffect) for effect in effects):
                shift = np.nan_to_num(Record(simulation, record.measured).read_states[0] - record.read_states[0])
                states = [s + shift[windows.rows] for windows, s in zip(self.blocks.windows, states, strict=True)]
            predicted = self._predicted(simulation, states)
        after = undelayed_following(simulation, record.measured)[:, record.seen]
        spread = record.spread[: record.num_readings]
        return [
            np.nan_to_num(after[windows.rows[:, None] + windows.horizons - 1] / spread - one, nan=DIVERGED)
            for windows, one in zip(self.blocks.windows, predicted, strict=True)
        ]

    @property
    def changes(self) -> list[np.ndarray]:
        """Changes of the readings in spreads, (W, h, n) for each kind of windows."""
        record = self.record
        before, after = (each[:, record.seen] / record.spread[: record.num_readings] for each in record.readings)
        windows = self.blocks.windows
        return [after[one.rows[:, None] + one.horizons - 1] - before[one.rows][:, None] for one in windows]

    @cached_property
    def variances(self) -> list[np.ndarray]:
        """Variance of the errors by sensor noise and uncertain start states, (W, h, n) for each kind of windows."""
        record, noise = self.record, self.starts.noise
        observed = record.simulation.pipeline.observe_memoryless
        zeros, step = np.zeros(len(record.simulation.state_map.names)), record.simulation.control_step
        gain = (observed(zeros + 1.0, step) - observed(zeros, step))[record.seen]
        floor = np.zeros((self.blocks.num_horizons, len(noise.sensor))) if self.floor is None else self.floor
        return [
            gain**2 * (self.starts.spread_ahead(windows) + noise.sensor**2)
            + ROUNDING**2
            + floor[np.log2(windows.horizons).astype(int)]
            for windows in self.blocks.windows
        ]

    def score(self, effects: Sequence[Effect] = ()) -> float:
        """Mean score of the blocks with effects added, in nats.

        Raises:
            ValueError: if the model rejects an effect.
        """
        errors = self.errors(effects)
        return float(scores(self, errors, fitted_scales(self, errors)).mean())

    def _predicted(self, simulation: Simulation, states: Sequence[np.ndarray]) -> list[np.ndarray]:
        record, measured = self.record, self.record.measured
        same = simulation is record.simulation
        executed = record.executed if same else executed_actions(simulation, measured)
        if same:
            active = record.activations
        else:
            active = activations(simulation, measured, executed, record.states[0], self.blocks.rows)
        n, found = record.num_readings, []
        for windows, start in zip(self.blocks.windows, states, strict=True):
            reached = simulation.rollout(
                start,
                executed[windows.all_rows],
                time=measured.time[windows.rows],
                activations=active[windows.rows],
            )
            found.append(simulation.observed(reached[:, windows.horizons - 1])[..., record.seen] / record.spread[:n])
        return found


def fitted_scales(predictions: Predictions, errors: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Variances by which errors exceed the noise, (h, n) for each kind of windows: those of the largest likelihood."""
    found = []
    for error, variance in zip(errors, predictions.variances, strict=True):
        some = slice(None, None, 1 + len(error) // SCALED)
        error, variance = error[some], variance[some]
        size = np.median(np.abs(error), axis=0) ** 2 + ROUNDING**2
        best, scale = np.full(size.shape, -np.inf), np.zeros_like(size)
        for factor in SCALES:
            density = _density(error, variance + factor * size).mean(0)
            scale = np.where(density > best, factor * size, scale)
            best = np.maximum(best, density)
        found.append(scale)
    return found


def scores(predictions: Predictions, errors: Sequence[np.ndarray], scales: Sequence[np.ndarray]) -> np.ndarray:
    """Log density of the readings in each block, (B), in nats: the mean over horizons, summed over readings."""
    blocks, total = predictions.blocks, np.zeros(len(predictions.blocks))
    for windows, share, error, variance, scale in zip(
        blocks.windows, predictions.shares, errors, predictions.variances, scales, strict=True
    ):
        density = _density(error, variance + scale).sum(2) @ share
        total += np.bincount(windows.block, density, len(blocks))
    return total


def _density(error: np.ndarray, variance: np.ndarray) -> np.ndarray:
    return log_density(error / np.sqrt(variance)) - 0.5 * np.log(variance)


@dataclass(frozen=True, eq=False)
class Model:
    """A simulation and its score: predictions on the rows for fits and on those for selection.

    Args:
        fit: predictions on the rows for fits.
        selection: predictions on the rows for selection.
    """

    fit: Predictions
    selection: Predictions
    _found: dict[tuple[Effect, ...], tuple[np.ndarray, np.ndarray, bool]] = field(default_factory=dict, repr=False)

    @classmethod
    def of(
        cls,
        simulation: Simulation,
        measured: Measured,
        noise: Noise | None = None,
    ) -> Model:
        """Builds the model of a simulation.

        Args:
            simulation: the simulator with its effects.
            measured: the data.
            noise: the noise; estimated from the rows for fits by default.
        """
        steps = block_steps(measured, simulation.control_step)
        blocks = [
            Blocks.of(measured, split, steps, max(rows, fewest * steps))
            for split, rows, fewest in (
                (Split.FIT, FIT_ROWS, FIT_BLOCKS),
                (Split.SELECTION, SELECTION_ROWS, SELECTION_BLOCKS),
            )
        ]
        record = Record(simulation, measured, np.concatenate([filtered_rows(one, measured) for one in blocks]))
        fit = StartStates.of(record, blocks[0], noise)
        selection = StartStates.of(record, blocks[1], fit.noise)
        return cls(Predictions(fit), Predictions(selection))

    def of_simulation(self, simulation: Simulation, measured: Measured | None = None) -> Model:
        """The same blocks, predicted by a similar simulation from start states that are filtered with it.

        Args:
            simulation: the simulator with its effects.
            measured: the same log with similar commands; that of this model by default.
        """
        record = self.fit.record
        record = replace(record, simulation=simulation, measured=measured or record.measured)
        fit = StartStates.of(record, self.fit.blocks, similar=self.fit.starts)
        selection = StartStates.of(record, self.selection.blocks, fit.noise, self.selection.starts)
        return Model(replace(self.fit, starts=fit), replace(self.selection, starts=selection))

    def with_commands(self, measured: Measured) -> Model:
        """The same predictions from the same start states, but with the commands of another log."""
        simulation = self.fit.record.simulation
        fit, selection = (part.of_simulation(simulation, measured) for part in (self.fit, self.selection))
        return Model(fit, selection)

    def scores(self, effects: Sequence[Effect] = ()) -> np.ndarray:
        """Scores with effects added: of the blocks for fits, then of those for selection, (F + S); see :func:`scores`.

        Raises:
            ValueError: if the model rejects an effect.
        """
        return self._scored(tuple(effects))[0]

    def one_step_ahead(self, effects: Sequence[Effect] = ()) -> tuple[np.ndarray, bool]:
        """Scores of all blocks one step ahead, (F + S), and whether these errors are noise of the motion.

        They are if they are larger than the sensors' noise, and independent in successive rows.
        """
        return self._scored(tuple(effects))[1:]

    def _scored(self, effects: tuple[Effect, ...]) -> tuple[np.ndarray, np.ndarray, bool]:
        if effects not in self._found:
            parts = [(part, part.errors(effects)) for part in (self.fit, self.selection)]
            scales = [fitted_scales(*each) for each in parts]
            by_block = [scores(*each, scale) for each, scale in zip(parts, scales, strict=True)]
            one_step = []
            for (part, errors), scale in zip(parts, scales, strict=True):
                density = _density(errors[0][:, 0], part.variances[0][:, 0] + scale[0][0]).sum(1)
                block = part.blocks.windows[0].block
                one_step.append(np.bincount(block, density) / np.bincount(block))
            (in_fit, *_), _ = scales
            known = self.selection.variances[0][:, 0]
            is_larger = np.median(in_fit[0] / np.median(known, axis=0)) > 1.0
            is_white = self.fit.likeness_of_neighbours(parts[0][1]) < WHITE
            self._found[effects] = np.concatenate(by_block), np.concatenate(one_step), bool(is_larger and is_white)
        return self._found[effects]
