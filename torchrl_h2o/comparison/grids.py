"""The paper's tables and figures as grids of runs: each run is a list of overrides of train.py."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import product

from omegaconf import DictConfig, OmegaConf

from torchrl_h2o.comparison.results_file import key_of
from torchrl_h2o.effects import PAPER_GAPS
from torchrl_h2o.training.methods import METHODS

SIX = ("sac", "cql", "iql", "darc", "h2o", "h2o_plus")
OFFLINE = ("cql", "iql")  # no simulator, so no gap: one run serves the whole row
MEDIUM, REPLAY = "halfcheetah/medium-v0", "halfcheetah/medium-replay-v0"
ENVS = {"halfcheetah": "HalfCheetah", "walker2d": "Walker2d"}


@dataclass(frozen=True)
class Grid:
    """What a table or figure of the paper is made of.

    Args:
        methods: by the names of methods.py.
        datasets: Minari names or files, in whose name the environment's stands; none for the robot's own.
        gaps: by the names of the paper; those that an environment has not are left out.
        strengths: of the gap; None is the paper's.
        tasks: environments with data of their own, instead of data sets and gaps.
        variants: further overrides, one run each.
    """

    methods: tuple[str, ...] = ("h2o_plus",)
    datasets: tuple[str, ...] = ()
    gaps: tuple[str, ...] = ("gravity",)
    strengths: tuple[float | None, ...] = (None,)
    tasks: tuple[str, ...] = ()
    variants: tuple[tuple[str, ...], ...] = field(default=((),))

    def runs(self, seeds: tuple[int, ...]) -> Iterator[list[str]]:
        """The overrides of each run, seed by seed, so that a grid that is broken off has every cell once."""
        for seed in seeds:
            worlds = [*product(self.datasets, self.gaps, self.strengths), *product(self.tasks, (None,), (None,))]
            done = set()
            for (world, gap, strength), method, variant in product(worlds, self.methods, self.variants):
                env, data = (world, None) if world in self.tasks else (env_of(world), world)
                gap = None if method in OFFLINE else gap
                overrides = _run(env, data, gap, strength, method, variant, seed)
                if overrides is not None and tuple(overrides) not in done:
                    done.add(tuple(overrides))
                    yield overrides


def env_of(data: str) -> str | None:
    """The environment whose name stands in that of a data set."""
    return next((env for env in ENVS if env in data), None)


def _run(
    env: str, data: str | None, gap: str | None, strength: float | None, method: str, variant: tuple, seed: int
) -> list[str] | None:
    chosen = [f"method={method}", f"env={env}"]
    if data is not None:
        if gap is not None and ENVS[env] not in PAPER_GAPS[gap].tasks:
            return None
        chosen += [f"data={data}", f"gap={'null' if gap is None else gap}"]
        if gap is not None and strength is not None:
            chosen.append(f"gap_strength={strength}")
    return [*chosen, *variant, f"seed={seed}"]


WITHOUT_RATIO = ("mixing=0.1", "ratio=false")
TABLES = {
    "returns": Grid(SIX, (REPLAY, MEDIUM, "walker2d/medium-replay-v0"), tuple(PAPER_GAPS)),
    "mixing": Grid(
        datasets=(REPLAY,),
        variants=(*((f"mixing={value}",) for value in (0.0, 0.1, 0.2, 0.5, 1.0)), WITHOUT_RATIO),
    ),
    "gaps": Grid(("h2o", "h2o_plus"), (REPLAY,), strengths=(1.25, 1.5, 2.0, 3.0)),
    "methods": Grid(SIX),  # not the paper's: on tasks of one's own
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
    """The table or figure that was asked for.

    Raises:
        ValueError: if there is none of that name, or not exactly one was asked for.
    """
    if (cfg.table is None) == (cfg.figure is None):
        raise ValueError(f"name one: table={' | '.join(TABLES)}, or figure={' | '.join(FIGURES)}")
    kind, name, there = ("table", cfg.table, TABLES) if cfg.figure is None else ("figure", cfg.figure, FIGURES)
    if name not in there:
        raise ValueError(f"{kind}={name}: choose {', '.join(there)}")
    return name


def chosen_grid(cfg: DictConfig) -> Grid:
    """The grid that was asked for, with the choices of the command line in the place of the paper's.

    Raises:
        ValueError: for a choice that there is not, or that these runs would not read.
    """
    name = group_name(cfg)
    asked = {key: cfg[key] for key in ("methods", "datasets", "gaps", "strengths", "tasks") if cfg[key] is not None}
    for key, value in asked.items():
        if not OmegaConf.is_list(value):
            raise ValueError(f"{key}={value}: give a list, {key}=[{value}]")
    chosen = {key: tuple(value) for key, value in asked.items()}
    there = {"methods": METHODS, "gaps": PAPER_GAPS}
    for key, names in there.items():
        for unknown in set(chosen.get(key, ())) - set(names):
            raise ValueError(f"{key}=[{unknown}]: choose {', '.join(names)}")
    for data in chosen.get("datasets", ()):
        if env_of(data) is None:
            raise ValueError(f"datasets=[{data}]: {' or '.join(ENVS)} is to stand in its name; see tasks=[...] too")
    grid = Grid(**(vars((TABLES | FIGURES)[name]) | chosen))
    if not grid.datasets and not grid.tasks:
        raise ValueError(f"{name} is of no environment yet: name tasks=[...], files in recipes/config/env/")
    if not grid.datasets and (idle := [key for key in ("gaps", "strengths") if key in chosen]):
        raise ValueError(f"{name} has no data sets that {' and '.join(idle)} would be put to: leave that out")
    return grid


def check_overrides(overrides: list[str], runs: list[list[str]]) -> None:
    """Refuses what each run of a grid says for itself.

    Raises:
        ValueError: naming what chooses among the runs.
    """
    chooses = {"method": "methods", "env": "tasks", "data": "datasets", "gap": "gaps", "gap_strength": "strengths"}
    chooses["seed"] = "seeds"
    of_runs = {key_of(override) for run in runs for override in run}
    if "gap" in of_runs:
        of_runs.add("gap_strength")  # some of them have no gap
    for override in overrides:
        if (key := key_of(override)) in of_runs:
            instead = f"choose with {chooses[key]}=[...]" if key in chooses else "leave it out, or take another grid"
            raise ValueError(f"{override}: the runs of this grid set {key} themselves; {instead}")
