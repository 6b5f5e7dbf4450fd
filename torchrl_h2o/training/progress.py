"""Training of one method inside a run: epochs, progress bar, metrics and checkpoints.

Every epoch has its own random stream, seeded from the run's seed and the epoch's number. A run that is resumed from a
checkpoint therefore draws the same random numbers as an uninterrupted one.
"""

from __future__ import annotations

import csv
import os
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig
from torch import Tensor, nn
from tqdm import tqdm

from torchrl_h2o.training.checkpoint import checkpoint_file, load_checkpoint, save_checkpoint
from torchrl_h2o.training.divergence import DivergenceError, are_finite, not_finite_losses
from torchrl_h2o.training.evaluators import Evaluator
from torchrl_h2o.training.interrupts import raise_lost_interrupt, uninterrupted
from torchrl_h2o.whole_file import whole_file


@dataclass(frozen=True)
class Budget:
    """Length of a training, and intervals of its evaluations and checkpoints.

    Args:
        updates: number of updates of the networks, rounded up to whole epochs.
        updates_per_epoch: updates between two collections in the simulator.
        eval_every: epochs between two evaluations; the policy is always evaluated after the last epoch.
        checkpoint_every: epochs between two checkpoints; a checkpoint is always written after the last epoch.
    """

    updates: int
    updates_per_epoch: int
    eval_every: int = 1
    checkpoint_every: int = 1

    @classmethod
    def from_config(cls, cfg: DictConfig) -> Budget:
        """Reads the budget from a run's configuration."""
        return cls(cfg.updates, cfg.updates_per_epoch, cfg.eval_every, cfg.checkpoint_every)

    @property
    def epochs(self) -> int:
        """Number of epochs."""
        return -(-self.updates // self.updates_per_epoch)


def epoch_seed(seed: int, epoch: int) -> int:
    """Computes the seed of an epoch's random stream from the run's seed and the epoch's number."""
    return int(np.random.SeedSequence((seed, epoch)).generate_state(1)[0])


class Training:
    """Epochs, metrics and checkpoints of one method; continues from the last checkpoint in the folder, if any.

    Args:
        name: name of the method, for the progress bar, the tables and the checkpoint folder.
        directory: the run's folder.
        budget: length of the training.
        **components: contents of a checkpoint (losses, optimisers, replay buffers).

    Raises:
        torchrl_h2o.data.DataError: if the checkpoint is damaged, or does not fit the components.
    """

    def __init__(self, name: str, directory: Path, budget: Budget, **components: Any) -> None:
        self.name, self.directory, self.budget = name, directory, budget
        self.progress: dict[str, Any] = {"epoch": 0, "seconds": 0.0, "update_seconds": 0.0, "rows": []}
        self._components = components
        self._update = 0  # of the current epoch
        self._awaited: tuple[Evaluator, int, dict[str, float]] | None = None  # the row of a running evaluation
        directory.mkdir(parents=True, exist_ok=True)
        self.checkpoint = checkpoint_file(directory, name)
        if self.checkpoint.exists():
            self.progress = load_checkpoint(self.checkpoint, components)
        self._saved = self.progress["epoch"]  # epochs in the last checkpoint

    @property
    def updates(self) -> int:
        """Total number of updates over all epochs."""
        return self.budget.epochs * self.budget.updates_per_epoch

    @property
    def rows(self) -> list[dict]:
        """The metrics so far, one row per evaluation; waits for a running one."""
        self._log_awaited()
        return self.progress["rows"]

    def epochs(self) -> Iterator[tuple[int, bool]]:
        """Yields each epoch's number and whether to evaluate at its end; then saves a checkpoint if one is due.

        A resumed run has the rows of all earlier evaluations. So while an evaluation runs, checkpoints are put off, at
        most until the epoch before the next evaluation.
        """
        done, size, due = self.progress["epoch"], self.budget.updates_per_epoch, False
        self._bar = tqdm(desc=self.name, total=self.updates, initial=done * size, unit=" updates")
        for epoch in range(done, self.budget.epochs):
            start = time.perf_counter()
            last = epoch + 1 == self.budget.epochs
            yield epoch, self._evaluates(epoch)
            self.progress["epoch"] = epoch + 1
            due |= last or (epoch + 1) % self.budget.checkpoint_every == 0
            latest = last or (due and self._evaluates(epoch + 1))
            if self._awaited is not None and (latest or self._awaited[0].is_done):
                self._log_awaited()
            self.progress["seconds"] += time.perf_counter() - start
            if due and self._awaited is None:
                due = False
                with uninterrupted():
                    save_checkpoint(self.checkpoint, self._components, self.progress)
                self._saved = epoch + 1
        self._bar.close()

    def _evaluates(self, epoch: int) -> bool:
        """Whether the policy is evaluated at the end of an epoch."""
        return epoch + 1 == self.budget.epochs or (epoch + 1) % self.budget.eval_every == 0

    def epoch_updates(self) -> Iterator[int]:
        """Yields the number of each update of an epoch, advances the progress bar and measures the time.

        Raises:
            DivergenceError: after the last update, if a parameter is not finite: before the policy is evaluated, and
                before a checkpoint replaces the last good one.
        """
        start = time.perf_counter()
        for update in range(self.budget.updates_per_epoch):
            self._update = update
            yield update
            raise_lost_interrupt()
            self._bar.update()
        self._check_parameters()
        self.progress["update_seconds"] += time.perf_counter() - start

    def check(self, losses: Mapping[str, Tensor]) -> None:
        """Stops the training at the first update with a loss that is not finite.

        Args:
            losses: terms of the current update by name, ``[]`` each.

        Raises:
            DivergenceError: with the loss, the update, the last checkpoint and what to change.
        """
        if (why := not_finite_losses(losses)) is not None:
            raise self._diverged(why)

    def _check_parameters(self) -> None:
        if not are_finite(part for part in self._components.values() if isinstance(part, nn.Module)):
            raise self._diverged("a parameter is not finite")

    def _diverged(self, why: str) -> DivergenceError:
        self._log_awaited()
        self._bar.close()
        size, epoch = self.budget.updates_per_epoch, self.progress["epoch"]
        before = epoch * size + self._update
        what = f"{self.name}: {why} at update {before + 1:,} of {self.updates:,} (epoch {epoch + 1})"
        kept = "There is no checkpoint yet: start"
        if self._saved:
            folder = os.path.relpath(self.directory)
            kept = (
                f"The checkpoint of update {self._saved * size:,} is kept; resume={folder} would repeat the same "
                f"numbers, so start"
            )
        optimiser = self._components.get("optimiser")
        lr = "" if optimiser is None else f" (now {optimiser.defaults['lr']:g})"
        return DivergenceError(f"{what}. {kept} a new run with a smaller lr{lr} or reward_scale.", what, before)

    @property
    def updates_per_second(self) -> float:
        """Updates per second; the time of collection and evaluation does not count."""
        return self.progress["epoch"] * self.budget.updates_per_epoch / self.progress["update_seconds"]

    def evaluate(self, evaluator: Evaluator, policy: nn.Module, epoch: int, **metrics: float) -> None:
        """Evaluates a policy and adds a row of metrics, as soon as the evaluator has the returns.

        The row is written to metrics.csv, and the mean return is shown beside the progress bar.

        Args:
            evaluator: evaluates; if it does so in a second process, the training goes on meanwhile.
            policy: the policy.
            epoch: number of the epoch.
            **metrics: further metrics of the row.
        """
        self._log_awaited()
        evaluator.start(policy)
        self._awaited = evaluator, epoch, metrics

    def _log_awaited(self) -> None:
        """Adds the row of a running evaluation, if there is one."""
        if self._awaited is None:
            return
        (evaluator, epoch, metrics), self._awaited = self._awaited, None
        self.progress["rows"].append(self._row(epoch, {**evaluator.result(), **metrics}))
        write_metrics(self.directory, self.name, self.progress["rows"])
        self._bar.set_postfix(return_real=f"{self.progress['rows'][-1]['return_real']:.0f}")

    def _row(self, epoch: int, metrics: dict[str, float]) -> dict:
        return {"method": self.name, "updates": (epoch + 1) * self.budget.updates_per_epoch, **metrics}


def write_metrics(directory: Path, method: str, rows: list[dict]) -> None:
    """Writes metrics.csv: one row per evaluation, one column per metric. Keeps the rows of other methods."""
    path = directory / "metrics.csv"
    if path.exists():
        with open(path, newline="") as file:
            rows = [row for row in csv.DictReader(file) if row["method"] != method] + rows
    first = ["method", "updates", "return_real", "return_real_std", "length_real"]
    others = {key for row in rows for key in row} - set(first)
    with whole_file(path) as partial, open(partial, "w", newline="") as file:
        writer = csv.DictWriter(file, [*first, *sorted(others)])
        writer.writeheader()
        writer.writerows(rows)
