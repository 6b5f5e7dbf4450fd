"""The sweeper behind paper.py: Hydra's own launchers run those of a grid's runs that are not done yet."""

import sys
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig


class PaperGrid(Sweeper):
    """Launches the runs of a table or figure; a run that dies is tried again, and the others go on."""

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        self.hydra_context, self.task_function, self.config = hydra_context, task_function, config
        self.launcher: Launcher | None = None
        self.composed: dict[str, DictConfig] = {}

    def sweep(self, arguments: list[str]) -> Sequence[JobReturn]:
        # Hydra imports every plugin at each start of any recipe: the library comes when a grid is run.
        from torchrl_h2o.comparison.grids import check_overrides, chosen_grid, group_name
        from torchrl_h2o.comparison.results_file import GRID, adopt_runs

        self.of_all = [argument for argument in arguments if argument.partition("=")[0] not in GRID | {"results"}]
        try:
            self.results = Path(
                self.config.results or Path(sys.argv[0]).resolve().parent / "results" / f"{group_name(self.config)}.csv"
            ).resolve()
            own = list(chosen_grid(self.config).runs(tuple(self.config.seeds)))
            check_overrides(self.of_all, own)
        except ValueError as error:
            sys.exit(f"{type(error).__name__}: {error}")
        runs = [[*run, *self.of_all] for run in own]
        adopt_runs(self.results, [self._identity(run) for run in runs])
        remaining = self._remaining(runs)
        print(f"{len(runs)} runs, {len(runs) - len(remaining)} of them done; results go to {self.results}")
        errors: dict[str, str] = {}
        try:
            for _ in range(1 + self.config.retries):
                if remaining:
                    errors = self._launch(remaining)
                    remaining = self._remaining(runs)
        except KeyboardInterrupt:
            sys.exit(f"\ninterrupted with {len(self._remaining(runs))} runs to go; the same command goes on with them")
        if remaining:
            sys.exit("\n".join(["these runs died:", *(self._obituary(run, errors) for run in remaining)]))
        return []

    def _launch(self, runs: list[list[str]]) -> dict[str, str]:
        """Launches runs; what those say that fail, by their folders."""
        self.launcher = Plugins.instance().instantiate_launcher(
            hydra_context=self.hydra_context, task_function=self.task_function, config=self.config
        )
        jobs = [[*run, f"results={self.results}", f"folder={self._folder(run)}"] for run in runs]
        try:
            returns = self.launcher.launch(jobs, initial_job_idx=0)
        except Exception as error:  # a worker that was killed takes the launcher's other jobs with it
            return {self._folder(run): repr(error) for run in runs}
        return {self._folder(run): said for run, job in zip(runs, returns, strict=True) if (said := _error_of(job))}

    def _remaining(self, runs: list[list[str]]) -> list[list[str]]:
        from torchrl_h2o.comparison.results_file import recorded

        done = recorded(self.results)
        return [run for run in runs if tuple(self._identity(run).values()) not in done]

    def _identity(self, run: list[str]) -> dict[str, str]:
        from torchrl_h2o.comparison.results_file import identity
        from torchrl_h2o.training.run_folder import resolve_paths

        own = run[: len(run) - len(self.of_all)]
        cfg = self._composed(next(override for override in own if override.startswith("env="))).copy()
        for override in OverridesParser.create().parse_overrides(own):
            if override.key_or_group != "env":
                cfg[override.key_or_group] = override.value()
        cfg.overrides = run
        resolve_paths(cfg)
        return identity(cfg)

    def _composed(self, env: str) -> DictConfig:
        """The configuration of an environment's runs, composed once: that takes Hydra a quarter of a second."""
        if env not in self.composed:
            load = self.hydra_context.config_loader.load_sweep_config
            self.composed[env] = load(self.config, [env, *self.of_all])
        return self.composed[env]

    def _folder(self, run: list[str]) -> str:
        """Below the grid's folder, the same for the same run: one that was broken off is found there."""
        who = self._identity(run)
        others = who.pop("others")
        names = [f"{key}_{value}" if key in ("seed", "updates") else value for key, value in who.items() if value]
        if others:  # may be longer than a folder's name can be
            names.append(sha256(others.encode()).hexdigest()[:8])
        return f"{self.results.stem}/{'__'.join(names).replace('/', '-')}"

    def _obituary(self, run: list[str], errors: dict[str, str]) -> str:
        folder = self._folder(run)
        return f"  {' '.join(run)}: {errors.get(folder, 'it left no error')} ({self.config.hydra.sweep.dir}/{folder})"


def _error_of(job: JobReturn) -> str | None:
    try:
        _ = job.return_value
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return None


def register_sweeper() -> None:
    """Makes Hydra know :class:`PaperGrid`, as ``hydra_plugins.torchrl_h2o.PaperGrid``.

    Hydra instantiates plugins of the namespace ``hydra_plugins`` alone, and finds them on ``sys.path``. Registering the
    class under that name needs neither a second top-level package nor an edit of the path.
    """
    PaperGrid.__module__ = "hydra_plugins.torchrl_h2o"
    Plugins.instance().register(PaperGrid)
