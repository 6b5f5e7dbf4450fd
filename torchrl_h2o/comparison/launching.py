"""Launches the unfinished runs of a grid with any Hydra launcher, and retries failed runs."""

from collections.abc import Iterable, Sequence
from hashlib import sha256
from pathlib import Path

from hydra._internal.callbacks import Callbacks
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from torchrl_h2o.comparison.results_file import GRID, adopt_runs, identity, read_rows, recorded
from torchrl_h2o.data.transition_checks import UnstableSimulatorError
from torchrl_h2o.training.divergence import DivergenceError
from torchrl_h2o.training.run_folder import resolve_paths

Run = list[str]  # overrides of train.py that distinguish this run from the others of its grid
REPEATABLE = (DivergenceError, UnstableSimulatorError)  # errors that a second attempt would end with as well


def shared_overrides(overrides: Iterable[str]) -> list[str]:
    """Select the overrides for all runs of a grid: all except those that choose the runs or the results file."""
    return [override for override in overrides if override.partition("=")[0] not in GRID | {"results"}]


NAMED = ("seed", "updates", "data_seconds", "mend")  # columns that a folder's name gives with their values


class GridLauncher:
    """Launches the unfinished runs of a grid. A failed run does not stop the others and is retried.

    Args:
        config: complete configuration of the grid's job, including its ``hydra`` node.
        results: CSV file of the group. Each finished run appends a row.
        shared: overrides for all runs, in addition to the individual ones.
        task: function that Hydra calls with the configuration of each run.
    """

    def __init__(self, config: DictConfig, results: Path, shared: Sequence[str], task: TaskFunction) -> None:
        self.config, self.results, self.shared, self.task = config, results, list(shared), task
        self._composed: dict[str, DictConfig] = {}

    @classmethod
    def of_this_job(cls, results: Path, shared: Sequence[str], task: TaskFunction) -> "GridLauncher":
        """Build a launcher with the ``hydra`` settings of the calling job, such as ``hydra/launcher=joblib``."""
        config = HydraConfig.instance().cfg
        assert isinstance(config, DictConfig), "call this inside a function decorated with hydra.main"
        return cls(config, results, shared, task)

    def run(self, runs: Sequence[Run], retries: int) -> list[str]:
        """Launch the runs that are not in the results file, until all are finished or the retries are used up.

        A run that diverged, or whose simulator did, is not retried: it would do so again.

        Args:
            runs: individual overrides of each run.
            retries: number of further attempts after the first.

        Returns:
            One line for each run that still failed: its overrides, the error and its folder.
        """
        adopt_runs(self.results, [self.identity(run) for run in runs])
        remaining = self.remaining(runs)
        print(f"{len(runs)} runs, {len(runs) - len(remaining)} of them done; results go to {self.results}")
        errors: dict[str, Exception] = {}
        for _ in range(1 + retries):
            again = [run for run in remaining if not isinstance(errors.get(self._folder(run)), REPEATABLE)]
            if again:
                errors |= self._launch(again)
                remaining = self.remaining(runs)
        return [self._failure(run, errors) for run in remaining]

    def remaining(self, runs: Sequence[Run]) -> list[Run]:
        """Return the runs that are not in the results file yet."""
        done = recorded(read_rows(self.results))
        return [run for run in runs if tuple(self.identity(run).values()) not in done]

    def identity(self, run: Run) -> dict[str, str]:
        """Return the columns of the results file that identify a run."""
        cfg = self._env_config(next(override for override in run if override.startswith("env="))).copy()
        for override in OverridesParser.create().parse_overrides(run):
            if override.key_or_group != "env":
                cfg[override.key_or_group] = override.value()
        cfg.overrides = [*run, *self.shared]
        resolve_paths(cfg)
        return identity(cfg)

    def _env_config(self, env: str) -> DictConfig:
        """Return the configuration of an environment's runs; cached, because Hydra needs 0.25 s to compose it."""
        if env not in self._composed:
            load = GlobalHydra.instance().config_loader().load_sweep_config
            self._composed[env] = load(self.config, [env, *self.shared])
        return self._composed[env]

    def _launch(self, runs: Sequence[Run]) -> dict[str, Exception]:
        """Launch runs and return the errors of those that fail, by folder."""
        loader = GlobalHydra.instance().config_loader()
        launcher = Plugins.instance().instantiate_launcher(
            hydra_context=HydraContext(config_loader=loader, callbacks=Callbacks(self.config)),
            task_function=self.task,
            config=self.config,
        )
        folders = [self._folder(run) for run in runs]
        jobs = [
            [*run, *self.shared, f"results={self.results}", f"folder={folder}"]
            for run, folder in zip(runs, folders, strict=True)
        ]
        try:
            returns = launcher.launch(jobs, initial_job_idx=0)
        except Exception as error:  # a killed worker ends all jobs of joblib's pool
            return dict.fromkeys(folders, error)
        errors = {folder: _error_of(job) for folder, job in zip(folders, returns, strict=True)}
        return {folder: error for folder, error in errors.items() if error is not None}

    def _folder(self, run: Run) -> str:
        """Return the run's folder inside the sweep's. It depends on the run only, so an interrupted run is found."""
        who = self.identity(run)
        others = who.pop("others")
        names = [f"{key}_{value}" if key in NAMED else value for key, value in who.items() if value]
        if others:  # may exceed the length of a folder's name
            names.append(sha256(others.encode()).hexdigest()[:8])
        return f"{self.results.stem}/{'__'.join(names).replace('/', '-')}"

    def _failure(self, run: Run, errors: dict[str, Exception]) -> str:
        folder = self._folder(run)
        overrides, error = " ".join([*run, *self.shared]), errors.get(folder)
        told = "no error was recorded" if error is None else f"{type(error).__name__}: {error}"
        return f"  {overrides}: {told} ({self.config.hydra.sweep.dir}/{folder})"


def _error_of(job: JobReturn) -> Exception | None:
    try:
        _ = job.return_value
    except Exception as error:
        return error
    return None
