"""The grid of ``figure=data_size``: the wheel-legged robot's methods with 2.5 to 83 s of real data."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig

from torchrl_h2o.options.nearest import did_you_mean

WHOLE = 83.0  # s, all real data: the recording and the real robot's log both have 16,588 rows, 82.94 s
SIZES = (2.5, 10.0, 30.0, WHOLE)
LOG = "log"  # task: standing still with the real robot's log as real data
#: environment or :data:`LOG`, and the amounts of real data in s
TASKS = {
    "wheel_legged": SIZES,
    "wheel_legged_forward": (SIZES[0], WHOLE),
    "wheel_legged_poor": (30.0,),
    LOG: (WHOLE,),
}
MENDED = "_mended"  # suffix of a method that is trained in the simulator mended from the same data
POSTERIOR = "_posterior"  # the same, with values drawn from the report's intervals and alternatives in each world
MEND = {"": "", MENDED: "true", POSTERIOR: "posterior"}  # value of the option ``mend`` for each suffix
METHODS = ("iql", "cql", "sac", "h2o", "h2o_plus", f"sac{MENDED}", f"h2o_plus{MENDED}", f"h2o_plus{POSTERIOR}")


def split_suffix(name: str) -> tuple[str, str]:
    """Split a name in :data:`METHODS` into the method and its suffix in :data:`MEND`.

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
        methods: names in :data:`METHODS`.
        tasks: names in :data:`TASKS`.
        sizes: amounts of real data in s, of those in :data:`TASKS`.
        log: file of the real robot's log; None leaves out its runs.

    Example:
        >>> grid = DataSizeGrid(methods=("iql", "sac_mended"), tasks=("wheel_legged",), sizes=(2.5,))
        >>> for run in grid.runs((0,)):
        ...     print(*run)
        method=iql env=wheel_legged data_seconds=2.5 seed=0
        method=sac env=wheel_legged data_seconds=2.5 mend=true seed=0
    """

    methods: tuple[str, ...] = METHODS
    tasks: tuple[str, ...] = tuple(TASKS)
    sizes: tuple[float, ...] = SIZES
    log: str | None = None

    def runs(self, seeds: tuple[int, ...]) -> Iterator[list[str]]:
        """Yield the overrides of each run. All runs of the first seed come first, so that they finish first.

        Args:
            seeds: seeds of the runs.
        """
        for seed in seeds:
            done = set()
            for task in self.tasks:
                for size in (size for size in TASKS[task] if size in self.sizes):
                    for method in self.methods:
                        run = tuple(self._run(task, size, method, seed))
                        if run not in done and not (task == LOG and self.log is None):
                            done.add(run)
                            yield list(run)

    def _run(self, task: str, size: float, method: str, seed: int) -> list[str]:
        name, suffix = split_suffix(method)
        if name == "sac" and not suffix:
            env = "wheel_legged_forward" if task == "wheel_legged_forward" else "wheel_legged"
            return [f"method={name}", f"env={env}", f"seed={seed}"]
        chosen = [f"method={name}", f"env={'wheel_legged' if task == LOG else task}"]
        if task == LOG:
            chosen.append(f"data={self.log}")
        if size != WHOLE:
            chosen.append(f"data_seconds={size:g}")
        if suffix:
            chosen.append(f"mend={MEND[suffix]}")
        return [*chosen, f"seed={seed}"]


def chosen_data_sizes(cfg: DictConfig) -> DataSizeGrid:
    """Build the grid with the selections ``methods``, ``tasks``, ``sizes`` and ``log`` of the command line.

    Raises:
        ValueError: for an unknown value, or a selection that this figure does not have.
    """
    if idle := [key for key in ("datasets", "gaps", "strengths") if cfg[key] is not None]:
        raise ValueError(f"data_size has no data sets and gaps, so {' and '.join(idle)} would have no effect")
    chosen = {}
    for key, known in {"methods": METHODS, "tasks": tuple(TASKS), "sizes": SIZES}.items():
        if cfg[key] is None:
            continue
        for unknown in set(cfg[key]) - set(known):
            names = list(map(str, known))
            raise ValueError(f"{key}=[{unknown}]: choose {', '.join(names)}{did_you_mean(unknown, names)}")
        chosen[key] = tuple(cfg[key])
    if cfg.log is None and LOG in chosen.get("tasks", ()):
        raise ValueError("tasks=[log] needs the file of the real robot's log: log=standing_still.txt")
    return DataSizeGrid(**chosen, log=None if cfg.log is None else str(Path(cfg.log).resolve()))
