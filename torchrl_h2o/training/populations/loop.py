"""Many runs in one process: every combination of ``seeds``, ``gaps`` and ``mixings``, stacked and trained together.

Each member has its own simulator and buffer. Its simulator is seeded like that of a single run; its updates draw other
numbers, so it equals a single run in its statistics, not to the digit. A member is stopped when its losses or
parameters are no longer finite, or when its simulator produces NaN: its networks are no longer changed, simulated or
evaluated. The other members are not affected. Only a simulator that produces NaN in its first epoch ends the whole
population, because each batch needs simulated rows of every member.
"""

from contextlib import ExitStack
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from torch.optim.lr_scheduler import LinearLR
from tqdm import tqdm

from torchrl_h2o.data.transition_checks import UnstableSimulatorError
from torchrl_h2o.training.checkpoint import checkpoint_file, save_checkpoint
from torchrl_h2o.training.config_file import save_config
from torchrl_h2o.training.cuda_graph import fit_to_device
from torchrl_h2o.training.divergence import are_finite
from torchrl_h2o.training.environments import as_observed, sim_capacity_of
from torchrl_h2o.training.interrupts import uninterrupted
from torchrl_h2o.training.loop import MakeLearner, Trainee
from torchrl_h2o.training.populations.learner import PopulationLearner
from torchrl_h2o.training.populations.replay import PopulationReplay
from torchrl_h2o.training.progress import Budget, Training, epoch_seed, write_metrics
from torchrl_h2o.training.warm_start import held_updates

SWEPT = {"seeds": "seed", "gaps": "gap", "mixings": "mixing"}


def members_of(cfg: DictConfig) -> dict[str, DictConfig]:
    """Build the configuration of each member, by name such as ``seed_0_gravity``; empty for a single run."""
    swept = {one: list(cfg[many]) for many, one in SWEPT.items() if cfg.get(many) is not None}
    members = {}
    for values in product(*swept.values()) if swept else ():
        chosen = dict(zip(swept, values, strict=True))
        name = "_".join(_word(key, value) for key, value in chosen.items())
        members[name] = OmegaConf.merge(cfg, chosen, dict.fromkeys(SWEPT))
    return members


def _word(key: str, value: object) -> str:
    if key == "gap":
        return "no_gap" if value is None else str(value)
    return f"{key}_{value}"


@dataclass(frozen=True)
class Outcome:
    """Result of a member.

    Args:
        policy: the policy selected by ``keep``.
        rows: metrics, one row per evaluation.
        updates: number of updates that the member made.
        updates_per_second: updates per second of each member.
        seconds: duration of the whole population's training, in s.
        failure: the number of updates after which the member stopped, and the reason; None if it did not stop.
    """

    policy: torch.nn.Module
    rows: list[dict]
    updates: int
    updates_per_second: float
    seconds: float
    failure: dict | None


class PopulationTraining(Training):
    """Epochs and checkpoints of a population, with the metrics of each member in the member's folder."""

    def rows_of(self, member: str) -> list[dict]:
        return [{k: v for k, v in row.items() if k != "member"} for row in self.rows if row["member"] == member]

    def log_member(self, epoch: int, member: str, **metrics: float) -> None:
        """Add a row of metrics and write the member's metrics.csv."""
        self.rows.append({"member": member, **self._row(epoch, metrics)})
        write_metrics(self.directory / member, self.name, self.rows_of(member))

    def note_failure(self, member: str, failure: dict) -> None:
        """Write a message when a member stops, once, and store the failure for the checkpoints."""
        if member not in self.failures:
            self.failures[member] = failure
            tqdm.write(f"{member} stopped after {failure['updates']} updates: {failure['why']}; the others go on")

    def _check_parameters(self) -> None:
        """Does nothing: the learner checks each member, and the others go on."""

    @property
    def failures(self) -> dict[str, dict]:
        """By stopped member: the number of updates that it made, and the reason."""
        return self.progress.setdefault("failures", {})


def train_population(
    make_learner: MakeLearner, cfg: DictConfig, members: dict[str, DictConfig], real: TensorDictBase, directory: Path
) -> dict[str, Outcome]:
    """Train all members.

    Args:
        make_learner: builds the learner of one run.
        cfg: the settings that the members share.
        members: the configuration of each member, by name.
        real: the measured transitions, ``[T]``.
        directory: the population's folder. Each member gets a folder in it, like the folder of a single run.

    Returns:
        The result of each member, by name.
    """
    for name, own in members.items():
        (directory / name).mkdir(parents=True, exist_ok=True)
        save_config(own, directory / name)
    capacity = sim_capacity_of(cfg, len(real))
    replay = PopulationReplay(
        as_observed(cfg, real),
        capacity,
        cfg.batch_size,
        len(members),
        n_steps=cfg.n_steps,
        gamma=cfg.gamma,
        device=cfg.device,
    )
    trainees = {
        name: Trainee(make_learner, own, buffer)
        for (name, own), buffer in zip(members.items(), replay.buffers, strict=True)
    }
    pairs = {}  # of each dynamics gap
    for name, own in members.items():
        if own.gap not in pairs:
            pairs[own.gap] = trainees[name].make_pairs(real)
        trainees[name].learner.pairs = pairs[own.gap]
    learners = [trainee.learner for trainee in trainees.values()]
    learner = PopulationLearner(learners, replay, cfg.lr, cfg.tau, held_updates(cfg))
    if replay.device.type != "cpu" and cfg.compiled is not False:  # on a CPU, compiled stacked networks are slower
        learner.use_cuda_graphs()
    budget = Budget.from_config(cfg)
    schedule = LinearLR(learner.optimiser, 1.0, cfg.lr_end_factor, total_iters=budget.epochs)
    training = PopulationTraining("H2O+", directory, budget, **_components(trainees, learner), schedule=schedule)
    fit_to_device(learner.optimiser, replay.device)
    learner.updates = training.progress["epoch"] * cfg.updates_per_epoch
    learner.failures = {n: training.failures[name] for n, name in enumerate(members) if name in training.failures}

    with ExitStack() as stack:
        for trainee in trainees.values():
            stack.callback(trainee.close)
        for epoch, evaluating in training.epochs():
            running = [(n, name, trainees[name]) for n, name in enumerate(members) if n not in learner.failures]
            if not running:
                break
            for number, _, trainee in running:
                try:
                    trainee.begin_epoch(epoch)
                except UnstableSimulatorError as error:
                    if trainee.learner.replay.num_sim == 0:  # a batch needs simulated rows of every member
                        raise UnstableSimulatorError(f"{name}: {error}") from error
                    learner.note_failure(number, str(error))
            torch.manual_seed(epoch_seed(cfg.seed, epoch))  # whichever members still simulate
            for _ in training.epoch_updates():
                terms = learner.update()
            learner.check_parameters()
            schedule.step()
            for number, name, trainee in running:
                if number in learner.failures:
                    training.note_failure(name, learner.failures[number])
                elif evaluating:
                    figures = trainee.learner.figures(*learner.batches_of(number))
                    losses = {key: term[number].item() for key, term in terms.items()}
                    trainee.evaluator.start(trainee.actor)
                    training.log_member(epoch, name, **trainee.evaluator.result(), **figures, **losses)
    return {name: _outcome(name, trainee, training) for name, trainee in trainees.items()}


def _components(trainees: dict[str, Trainee], learner: PopulationLearner) -> dict:
    """Collect the contents of a checkpoint: the members' components and the shared optimiser."""
    parts = {
        f"{name}_{part}": component
        for name, trainee in trainees.items()
        for part, component in trainee.components.items()
        if part != "optimiser"
    }
    return {**parts, "optimiser": learner.optimiser}


def _outcome(name: str, trainee: Trainee, training: PopulationTraining) -> Outcome:
    """Build a member's result, and save its policy in the member's folder for evaluate.py."""
    policies = {key: trainee.components[key] for key in ("actor", "policy") if key in trainee.components}
    failure = training.failures.get(name)
    updates = training.updates if failure is None else failure["updates"]
    if are_finite(policies.values()):  # a policy that diverged cannot be evaluated
        with uninterrupted():
            save_checkpoint(checkpoint_file(training.directory / name, training.name), policies, training.progress)
    return Outcome(
        trainee.policy,
        training.rows_of(name),
        updates,
        training.updates_per_second,
        training.progress["seconds"],
        failure,
    )
