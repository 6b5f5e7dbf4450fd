"""Grids of runs for the paper's tables and figures, and for our own. A run is a list of overrides of recipes/train.py.

The paper is H2O+, Niu et al. (2023), arXiv 2309.12716.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import cast

from omegaconf import DictConfig

from torchrl_h2o.comparison.results_file import key_of
from torchrl_h2o.effects import PAPER_GAPS
from torchrl_h2o.options.nearest import did_you_mean
from torchrl_h2o.options.train import OFFLINE
from torchrl_h2o.training.methods import METHODS

SIX = ("sac", "cql", "iql", "darc", "h2o", "h2o_plus")
MEDIUM, REPLAY = "halfcheetah/medium-v0", "halfcheetah/medium-replay-v0"
ENVS = {"halfcheetah": "HalfCheetah", "walker2d": "Walker2d"}


@dataclass(frozen=True)
class Grid:
    """The factors of a table or figure. Its runs are all combinations of their values.

    Args:
        methods: names in :data:`torchrl_h2o.training.methods.METHODS`.
        datasets: Minari data sets or files; the name must contain the environment's name.
        gaps: names of the paper's gaps; gaps that an environment does not support are skipped.
        strengths: strengths of the gap; None is the paper's strength.
        tasks: environments with their own data, used instead of data sets and gaps.
        variants: further overrides, one tuple per variant.
    """

    methods: tuple[str, ...] = ("h2o_plus",)
    datasets: tuple[str, ...] = ()
    gaps: tuple[str, ...] = ("gravity",)
    strengths: tuple[float | None, ...] = (None,)
    tasks: tuple[str, ...] = ()
    variants: tuple[tuple[str, ...], ...] = field(default=((),))

    def runs(self, seeds: tuple[int, ...]) -> Iterator[list[str]]:
        """Yield the overrides of each run. The first seed's runs come first, so that they finish first.

        Args:
            seeds: seeds of the runs.
        """
        worlds = [*product(self.datasets, self.gaps, self.strengths), *product(self.tasks, (None,), (None,))]
        for seed in seeds:
            runs = {}  # each once
            for (world, gap, strength), method, variant in product(worlds, self.methods, self.variants):
                # chosen_grid has checked that data sets name an environment
                env, data = (world, None) if world in self.tasks else (cast(str, env_of(world)), world)
                run = _run(env, data, None if method in OFFLINE else gap, strength, method)
                if run is not None:
                    runs[(*run, *variant, f"seed={seed}")] = None
            yield from map(list, runs)


def env_of(data: str) -> str | None:
    """Return the environment whose name occurs in the data set's name, or None."""
    return next((env for env in ENVS if env in data), None)


def _run(env: str, data: str | None, gap: str | None, strength: float | None, method: str) -> list[str] | None:
    """Overrides of a run without its variant and seed; None for a gap that the environment does not have."""
    chosen = [f"method={method}", f"env={env}"]
    if data is None:
        return chosen
    if gap is None:
        return [*chosen, f"data={data}", "gap=null"]
    if ENVS[env] not in PAPER_GAPS[gap].tasks:
        return None
    return [*chosen, f"data={data}", f"gap={gap}", *([] if strength is None else [f"gap_strength={strength}"])]


MENDED = "_mended"  # suffix of a method that is trained in the simulator mended from the same data


#: files of the benchmark of others and methods, the most informative first, because runs are in this order
OFF_DYNAMICS_FILES = tuple(
    f"{env}_{change}_{quality}"
    for change in ("gravity_0.5", "kinematic", "morph")
    for quality in ("expert", "medium", "medium_expert")
    for env in ("walker2d", "halfcheetah")
)
OFF_DYNAMICS_METHODS = (f"h2o_plus{MENDED}", f"sac{MENDED}", "h2o_plus", "sac", "iql", "td3_bc", "h2o")


@dataclass(frozen=True)
class OffDynamicsGrid:
    """Runs with the target data of OTDF, whose dynamics differ from the unmodified task, in which policies are trained.

    Methods are as published. Those in the mended simulator have the options of ``recipes/h2o_plus.py``. SAC in the
    unmodified task reads no data, so it is run once per change.

    Args:
        folder: folder with the files.
        methods: names in :data:`OFF_DYNAMICS_METHODS`.
        tasks: names in :data:`OFF_DYNAMICS_FILES`.

    Example:
        >>> grid = OffDynamicsGrid("data", ("sac_mended",), ("walker2d_morph_medium",))
        >>> print(*next(grid.runs((0,)))[:4])
        method=sac env=walker2d_morph data=data/walker2d_morph_medium.hdf5 mend=true

    Source: J. Lyu et al., "Cross-Domain Offline Policy Adaptation with Optimal Transport and Dataset Constraint", ICLR
    2025; the files are in github.com/dmksjfl/OTDF.
    """

    folder: str
    methods: tuple[str, ...] = OFF_DYNAMICS_METHODS
    tasks: tuple[str, ...] = OFF_DYNAMICS_FILES

    def runs(self, seeds: tuple[int, ...]) -> Iterator[list[str]]:
        """Yield the overrides of each run. The first seed's runs come first, file by file.

        Args:
            seeds: seeds of the runs.
        """
        for seed in seeds:
            runs = [(*self._run(file, method), f"seed={seed}") for file in self.tasks for method in self.methods]
            yield from map(list, dict.fromkeys(runs))

    def _run(self, file: str, method: str) -> list[str]:
        env = env_of_file(file)
        if method == "sac":
            file = next(one for one in OFF_DYNAMICS_FILES if env_of_file(one) == env)
        chosen = [f"method={method.removesuffix(MENDED)}", f"env={env}", f"data={self.folder}/{file}.hdf5"]
        return chosen + (["mend=true", "warm_start=true", "keep=best_in_simulator"] if method.endswith(MENDED) else [])


def env_of_file(file: str) -> str:
    """Return the environment in config/env/ of a file in :data:`OFF_DYNAMICS_FILES`.

    Example:
        >>> env_of_file("walker2d_gravity_0.5_medium")
        'walker2d_gravity'
    """
    return "_".join(file.split("_")[:2])


WITHOUT_RATIO = ("mixing=0.1", "ratio=false")
TABLES = {
    "returns": Grid(SIX, (REPLAY, MEDIUM, "walker2d/medium-replay-v0"), tuple(PAPER_GAPS)),
    "mixing": Grid(
        datasets=(REPLAY,),
        variants=(*((f"mixing={value}",) for value in (0.0, 0.1, 0.2, 0.5, 1.0)), WITHOUT_RATIO),
    ),
    "gaps": Grid(("h2o", "h2o_plus"), (REPLAY,), strengths=(1.25, 1.5, 2.0, 3.0)),
    "methods": Grid(SIX),  # not in the paper: for tasks of your own
    "off_dynamics": OffDynamicsGrid("."),  # not in the paper; folder_of_data=... gives the folder
}
FIGURES = {
    "backbones": Grid(
        datasets=(MEDIUM, REPLAY),
        gaps=("small_thigh", "big_thigh"),
        variants=(("backbone=expectile",), ("backbone=sparse",)),
    ),
    "wheel_legged": Grid(SIX, tasks=("wheel_legged", "wheel_legged_forward")),
}


def group_name(cfg: DictConfig) -> str:
    """Return the name of the requested table or figure."""
    return cfg.table if cfg.figure is None else cfg.figure


def chosen_grid(cfg: DictConfig) -> Grid | OffDynamicsGrid:
    """Build the requested grid. Options on the command line replace the paper's values.

    Raises:
        ValueError: for an unknown value, or an option that has no effect on these runs.
    """
    name = group_name(cfg)
    grid = (TABLES | FIGURES)[name]
    if isinstance(grid, OffDynamicsGrid):
        return chosen_off_dynamics(cfg)
    if cfg.folder_of_data is not None:
        raise ValueError(f"{name} has no folder of data: leave out folder_of_data, or take table=off_dynamics")
    lists = {key: cfg[key] for key in ("methods", "datasets", "gaps", "strengths", "tasks") if cfg[key] is not None}
    chosen = {key: tuple(value) for key, value in lists.items()}
    for unknown in set(chosen.get("methods", ())) - set(METHODS):
        raise ValueError(f"methods=[{unknown}]: choose {', '.join(METHODS)}{did_you_mean(unknown, METHODS)}")
    for data in chosen.get("datasets", ()):
        if env_of(data) is None:
            raise ValueError(
                f"datasets=[{data}]: its name must contain {' or '.join(ENVS)}; for other environments see tasks=[...]"
            )
    grid = Grid(**(vars(grid) | chosen))
    if not grid.datasets and not grid.tasks:
        raise ValueError(f"{name} has no environment yet: name tasks=[...], files in recipes/config/env/")
    if not grid.datasets and (idle := [key for key in ("gaps", "strengths") if key in chosen]):
        raise ValueError(f"{name} has no data sets, so {' and '.join(idle)} would have no effect: leave that out")
    return grid


def chosen_off_dynamics(cfg: DictConfig) -> OffDynamicsGrid:
    """Build the grid with the selections ``methods`` and ``tasks``, and ``folder_of_data``, of the command line.

    Raises:
        ValueError: for an unknown value, a selection that this table does not have, or no folder.
    """
    if idle := [key for key in ("datasets", "gaps", "strengths") if cfg[key] is not None]:
        raise ValueError(f"off_dynamics has the files of a folder, so {' and '.join(idle)} would have no effect")
    chosen = {}
    for key, known in (("methods", OFF_DYNAMICS_METHODS), ("tasks", OFF_DYNAMICS_FILES)):
        for unknown in set(cfg[key] or ()) - set(known):
            raise ValueError(f"{key}=[{unknown}]: choose {', '.join(known)}{did_you_mean(unknown, known)}")
        if cfg[key] is not None:
            chosen[key] = tuple(cfg[key])
    if cfg.folder_of_data is None:
        raise ValueError("off_dynamics needs the folder datasets/ of github.com/dmksjfl/OTDF: folder_of_data=datasets")
    folder = Path(cfg.folder_of_data).resolve()
    grid = OffDynamicsGrid(str(folder), **chosen)
    if missing := [file for file in grid.tasks if not (folder / f"{file}.hdf5").is_file()]:
        raise ValueError(f"folder_of_data={cfg.folder_of_data}: it has no {missing[0]}.hdf5; choose with tasks=[...]")
    return grid


def check_overrides(overrides: list[str], runs: list[list[str]]) -> None:
    """Reject shared overrides of settings that differ between the runs of the grid.

    Args:
        overrides: overrides for all runs.
        runs: the individual overrides of each run.

    Raises:
        ValueError: for such an override; the message gives the option to use instead.
    """
    selects = {"method": "methods", "env": "tasks", "data": "datasets", "gap": "gaps", "gap_strength": "strengths"}
    selects |= {"seed": "seeds", "mend": "methods"}
    of_runs = {key_of(override) for run in runs for override in run}
    if "gap" in of_runs:
        of_runs.add("gap_strength")  # runs without a gap would reject it
    for override in overrides:
        if (key := key_of(override)) in of_runs:
            instead = f"choose with {selects[key]}=[...]" if key in selects else "leave it out, or take another grid"
            raise ValueError(f"{override}: the runs of this grid set {key} themselves; {instead}")
