"""Many runs in one process: every combination of ``seeds``, ``gaps`` and ``mixings``, stacked and trained as one.

Each member has its simulator, its buffer and its random stream, and draws from it in the order in which a single run
draws: on a CPU it reaches that run's numbers, to rounding. A member whose losses are no finite numbers any more stops:
its networks stay as they are, it is neither simulated nor evaluated, and the others go on as if nothing had happened.
"""

from contextlib import ExitStack
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from torch.optim.lr_scheduler import LinearLR
from torchrl.checkpoint import Checkpoint, CheckpointRotation
from tqdm import tqdm

from torchrl_h2o.training.compiling import maybe_compiled
from torchrl_h2o.training.environments import as_observed
from torchrl_h2o.training.loop import MakeLearner, Trainee
from torchrl_h2o.training.populations.learner import PopulationLearner
from torchrl_h2o.training.populations.replay import PopulationReplay
from torchrl_h2o.training.progress import Budget, Training, write_metrics
from torchrl_h2o.training.run_folder import checkpoint_folder, save_config, uninterrupted

SWEPT = {"seeds": "seed", "gaps": "gap", "mixings": "mixing"}


def members_of(cfg: DictConfig) -> dict[str, DictConfig]:
    """The configuration of each member by its name, such as ``seed_0_gravity``; none for a single run.

    Raises:
        ValueError: for what is no list, is empty, or names a member twice.
    """
    swept = {one: _listed(cfg, many) for many, one in SWEPT.items() if cfg.get(many) is not None}
    members = {}
    for values in product(*swept.values()) if swept else ():
        chosen = dict(zip(swept, values, strict=True))
        name = "_".join(_word(key, value) for key, value in chosen.items())
        if name in members:
            raise ValueError(f"{name} is in the population twice: name each of seeds, gaps and mixings once")
        members[name] = OmegaConf.merge(cfg, chosen, dict.fromkeys(SWEPT))
    return members


def _listed(cfg: DictConfig, key: str) -> list:
    if not OmegaConf.is_list(cfg[key]) or not len(cfg[key]):
        raise ValueError(f"{key}={cfg[key]}: give a list of at least one, such as {key}=[{cfg[SWEPT[key]]}]")
    return list(cfg[key])


def _word(key: str, value: object) -> str:
    if key == "gap":
        return "no_gap" if value is None else str(value)
    return f"{key}_{value}"


@dataclass(frozen=True)
class Outcome:
    """What became of a member.

    Args:
        policy: the one to hand over.
        rows: its metrics, one row an evaluation.
        updates: that it made.
        updates_per_second: of this member; the population made as many of each.
        seconds: that the whole population took.
        failure: after how many updates it stopped, and why; or None.
    """

    policy: torch.nn.Module
    rows: list[dict]
    updates: int
    updates_per_second: float
    seconds: float
    failure: dict | None


class PopulationTraining(Training):
    """Epochs and checkpoints of a population, and the metrics of each member in a folder of its own."""

    def rows_of(self, member: str) -> list[dict]:
        return [{k: v for k, v in row.items() if k != "member"} for row in self.rows if row["member"] == member]

    def log_member(self, epoch: int, member: str, **metrics: float) -> None:
        """Adds a row of metrics and writes the member's metrics.csv."""
        self.rows.append({"member": member, **self._row(epoch, metrics)})
        write_metrics(self.directory / member, self.name, self.rows_of(member))

    def note_failure(self, member: str, failure: dict) -> None:
        """Reports that a member has stopped, once; a checkpoint remembers it."""
        if member not in self.failures:
            self.failures[member] = failure
            tqdm.write(f"{member} stopped after {failure['updates']} updates: {failure['why']}; the others go on")

    @property
    def failures(self) -> dict[str, dict]:
        """By the members that stopped: after how many updates, and why."""
        return self.progress.setdefault("failures", {})


def train_population(
    make_learner: MakeLearner, cfg: DictConfig, members: dict[str, DictConfig], real: TensorDictBase, directory: Path
) -> dict[str, Outcome]:
    """Trains all members.

    Args:
        make_learner: of one run.
        cfg: what the members have in common.
        members: their configurations, by name.
        real: the measured transitions.
        directory: of the population; each member has a folder of its own in it, like a single run's.

    Returns:
        What became of each member.
    """
    for name, own in members.items():
        (directory / name).mkdir(parents=True, exist_ok=True)
        save_config(own, directory / name)
    real = as_observed(cfg, real)
    capacity = int(cfg.sim_capacity * len(real))
    replay = PopulationReplay(real, capacity, cfg.batch_size, len(members), device=cfg.device)
    trainees = {
        name: Trainee(make_learner, own, buffer)
        for (name, own), buffer in zip(members.items(), replay.buffers, strict=True)
    }
    learner = PopulationLearner([trainee.learner for trainee in trainees.values()], replay, cfg.lr, cfg.tau)
    learner.losses_of = maybe_compiled(
        learner.losses_of, cfg.get("compiled", False), cfg.updates, pays=False
    )  # on a CPU, stacked ones are slower so
    budget = Budget.from_config(cfg)
    schedule = LinearLR(learner.optimiser, 1.0, cfg.lr_end_factor, total_iters=budget.epochs)
    training = PopulationTraining("H2O+", directory, budget, **_components(trainees, learner), schedule=schedule)
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
                trainee.begin_epoch(epoch)
                learner.start_stream(number)
            for _ in training.epoch_updates():
                terms = learner.update()
            learner.check_parameters()
            schedule.step()
            for number, name, trainee in running:
                if number in learner.failures:
                    training.note_failure(name, learner.failures[number])
                elif evaluating:
                    trainee.learner.batches = learner.batches_of(number)
                    losses = {key: term[number].item() for key, term in terms.items()}
                    training.log_member(epoch, name, **trainee.look(training.rows_of(name)), **losses)
    return {name: _outcome(name, trainee, training) for name, trainee in trainees.items()}


def _components(trainees: dict[str, Trainee], learner: PopulationLearner) -> dict:
    """What a checkpoint of the population holds: its members', and the optimiser that is theirs together."""
    parts = {
        f"{name}_{part}": component
        for name, trainee in trainees.items()
        for part, component in trainee.components.items()
        if part != "optimiser"
    }
    return {**parts, "optimiser": learner.optimiser}


def _outcome(name: str, trainee: Trainee, training: PopulationTraining) -> Outcome:
    """Also leaves the policy in the member's folder, where evaluate.py looks for it."""
    policies = {key: trainee.components[key] for key in ("actor", "policy") if key in trainee.components}
    rotation = CheckpointRotation(checkpoint_folder(training.directory / name, training.name), keep_last=1)
    failure = training.failures.get(name)
    updates = training.updates if failure is None else failure["updates"]
    with uninterrupted():
        rotation.save(Checkpoint(format="archive", **policies), step=updates)
    return Outcome(
        trainee.policy,
        training.rows_of(name),
        updates,
        training.updates_per_second,
        training.progress["seconds"],
        failure,
    )
