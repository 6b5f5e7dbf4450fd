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


WHOLE = 83.0  # s, all real data: the recording and the real robot's log both have 16,588 rows, 82.94 s
SIZES = (2.5, 10.0, 30.0, WHOLE)
LOG = "log"  # task: standing still with the real robot's log as real data
#: environment or :data:`LOG`, and the amounts of real data in s
DATA_SIZE_TASKS = {
    "wheel_legged": SIZES,
    "wheel_legged_forward": (SIZES[0], WHOLE),
    "wheel_legged_poor": (30.0,),
    LOG: (WHOLE,),
}
MENDED = "_mended"  # suffix of a method that is trained in the simulator mended from the same data
POSTERIOR = "_posterior"  # the same, with values drawn from the report's intervals and alternatives in each world
MEND = {"": "", MENDED: "true", POSTERIOR: "posterior"}  # value of the option ``mend`` for each suffix
DATA_SIZE_METHODS = (
    "iql",
    "cql",
    "sac",
    "h2o",
    "h2o_plus",
    f"sac{MENDED}",
    f"h2o_plus{MENDED}",
    f"h2o_plus{POSTERIOR}",
)


def split_suffix(name: str) -> tuple[str, str]:
    """Split a name in :data:`DATA_SIZE_METHODS` into the method and its suffix in :data:`MEND`.

    Example:
        >>> split_suffix("h2o_plus_mended"), split_suffix("iql")
        (('h2o_plus', '_mended'), ('iql', ''))
    """
    suffix = next((suffix for suffix in (MENDED, POSTERIOR) if name.endswith(suffix)), "")
    return name.removesuffix(suffix), suffix


@dataclass(frozen=True)
class DataSizeGrid:
    """Runs of the robot with different amounts of real data.

    All methods and seeds use the same rows: the first seconds of the data. SAC in the simulator that is not mended
    learns from simulated rows alone. It depends on the data only through the normalisation of the observations, so it
    is run once per task, with the normalisation of the whole recording.

    Args:
        methods: names in :data:`DATA_SIZE_METHODS`.
        tasks: names in :data:`DATA_SIZE_TASKS`.
        sizes: amounts of real data in s, of those in :data:`DATA_SIZE_TASKS`.
        log: file of the real robot's log; None leaves out its runs.

    Example:
        >>> grid = DataSizeGrid(methods=("iql", "sac_mended"), tasks=("wheel_legged",), sizes=(2.5,))
        >>> for run in grid.runs((0,)):
        ...     print(*run)
        method=iql env=wheel_legged data_seconds=2.5 seed=0
        method=sac env=wheel_legged data_seconds=2.5 mend=true seed=0
    """

    methods: tuple[str, ...] = DATA_SIZE_METHODS
    tasks: tuple[str, ...] = tuple(DATA_SIZE_TASKS)
    sizes: tuple[float, ...] = SIZES
    log: str | None = None

    def runs(self, seeds: tuple[int, ...]) -> Iterator[list[str]]:
        """Yield the overrides of each run. All runs of the first seed come first, so that they finish first.

        Args:
            seeds: seeds of the runs.
        """
        tasks = [task for task in self.tasks if task != LOG or self.log is not None]
        worlds = [(task, size) for task in tasks for size in DATA_SIZE_TASKS[task] if size in self.sizes]
        for seed in seeds:
            runs = [(*self._run(*world, method), f"seed={seed}") for world in worlds for method in self.methods]
            yield from map(list, dict.fromkeys(runs))

    def _run(self, task: str, size: float, method: str) -> list[str]:
        name, suffix = split_suffix(method)
        env = "wheel_legged" if task == LOG else task
        if name == "sac" and not suffix:
            return [f"method={name}", f"env={env.removesuffix('_poor')}"]
        chosen = [f"method={name}", f"env={env}", *([f"data={self.log}"] if task == LOG else [])]
        chosen += [f"data_seconds={size:g}"] if size != WHOLE else []
        return chosen + ([f"mend={MEND[suffix]}"] if suffix else [])


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
        name, suffix = split_suffix(method)
        env = env_of_file(file)
        if method == "sac":
            file = next(one for one in OFF_DYNAMICS_FILES if env_of_file(one) == env)
        chosen = [f"method={name}", f"env={env}", f"data={self.folder}/{file}.hdf5"]
        return chosen + ([f"mend={MEND[suffix]}", "warm_start=true", "keep=best_in_simulator"] if suffix else [])


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
    "data_size": DataSizeGrid(),  # not in the paper
}


def group_name(cfg: DictConfig) -> str:
    """Return the name of the requested table or figure."""
    return cfg.table if cfg.figure is None else cfg.figure


def chosen_grid(cfg: DictConfig) -> Grid | DataSizeGrid | OffDynamicsGrid:
    """Build the requested grid. Options on the command line replace the paper's values.

    Raises:
        ValueError: for an unknown value, or an option that has no effect on these runs.
    """
    name = group_name(cfg)
    grid = (TABLES | FIGURES)[name]
    if isinstance(grid, DataSizeGrid):
        return chosen_data_sizes(cfg)
    if isinstance(grid, OffDynamicsGrid):
        return chosen_off_dynamics(cfg)
    if cfg.folder_of_data is not None:
        raise ValueError(f"{name} has no folder of data: leave out folder_of_data, or take table=off_dynamics")
    if idle := [key for key in ("sizes", "log") if cfg[key] is not None]:
        raise ValueError(f"only figure=data_size has amounts of real data: leave out {' and '.join(idle)}")
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


def chosen_data_sizes(cfg: DictConfig) -> DataSizeGrid:
    """Build the grid with the selections ``methods``, ``tasks``, ``sizes`` and ``log`` of the command line.

    Raises:
        ValueError: for an unknown value, or a selection that this figure does not have.
    """
    if idle := [key for key in ("datasets", "gaps", "strengths", "folder_of_data") if cfg[key] is not None]:
        raise ValueError(f"data_size has no data sets and gaps, so {' and '.join(idle)} would have no effect")
    chosen = _selected(cfg, {"methods": DATA_SIZE_METHODS, "tasks": tuple(DATA_SIZE_TASKS), "sizes": SIZES})
    if cfg.log is None and LOG in chosen.get("tasks", ()):
        raise ValueError("tasks=[log] needs the file of the real robot's log: log=standing_still.txt")
    return DataSizeGrid(**chosen, log=None if cfg.log is None else str(Path(cfg.log).resolve()))


def chosen_off_dynamics(cfg: DictConfig) -> OffDynamicsGrid:
    """Build the grid with the selections ``methods`` and ``tasks``, and ``folder_of_data``, of the command line.

    Raises:
        ValueError: for an unknown value, a selection that this table does not have, or no folder.
    """
    if idle := [key for key in ("datasets", "gaps", "strengths", "sizes", "log") if cfg[key] is not None]:
        raise ValueError(f"off_dynamics has the files of a folder, so {' and '.join(idle)} would have no effect")
    chosen = _selected(cfg, {"methods": OFF_DYNAMICS_METHODS, "tasks": OFF_DYNAMICS_FILES})
    if cfg.folder_of_data is None:
        raise ValueError("off_dynamics needs the folder datasets/ of github.com/dmksjfl/OTDF: folder_of_data=datasets")
    folder = Path(cfg.folder_of_data).resolve()
    grid = OffDynamicsGrid(str(folder), **chosen)
    if missing := [file for file in grid.tasks if not (folder / f"{file}.hdf5").is_file()]:
        raise ValueError(f"folder_of_data={cfg.folder_of_data}: it has no {missing[0]}.hdf5; choose with tasks=[...]")
    return grid


def _selected(cfg: DictConfig, known: dict[str, tuple]) -> dict[str, tuple]:
    """The selections of the command line, each of known values; ValueError for others."""
    chosen = {}
    for key, values in known.items():
        if cfg[key] is None:
            continue
        for unknown in set(cfg[key]) - set(values):
            names = list(map(str, values))
            raise ValueError(f"{key}=[{unknown}]: choose {', '.join(names)}{did_you_mean(unknown, names)}")
        chosen[key] = tuple(cfg[key])
    return chosen


def check_overrides(overrides: list[str], runs: list[list[str]]) -> None:
    """Reject shared overrides of settings that differ between the runs of the grid.

    Args:
        overrides: overrides for all runs.
        runs: the individual overrides of each run.

    Raises:
        ValueError: for such an override; the message gives the option to use instead.
    """
    selects = {"method": "methods", "env": "tasks", "data": "datasets", "gap": "gaps", "gap_strength": "strengths"}
    selects |= {"seed": "seeds", "data_seconds": "sizes", "mend": "methods"}
    of_runs = {key_of(override) for run in runs for override in run}
    if "gap" in of_runs:
        of_runs.add("gap_strength")  # runs without a gap would reject it
    for override in overrides:
        if (key := key_of(override)) in of_runs:
            instead = f"choose with {selects[key]}=[...]" if key in selects else "leave it out, or take another grid"
            raise ValueError(f"{override}: the runs of this grid set {key} themselves; {instead}")
