"""The results of ``figure=data_size``, arranged by panel, method and seconds of real data, and their table."""

import statistics
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from torchrl_h2o.comparison.data_size_grid import MEND, METHODS, SIZES, WHOLE, split_suffix
from torchrl_h2o.comparison.scores import MixedRunsError, Row
from torchrl_h2o.training.methods import METHODS as ALL_METHODS

STANDING, FORWARD, POOR = "standing still", "moving forward", "standing still, poor data"
REAL_LOG = "standing still, the real robot's log"
PANELS = (STANDING, FORWARD, POOR, REAL_LOG)
FAULTLESS = {STANDING: 180_000.0, FORWARD: 90_000.0, POOR: 180_000.0, REAL_LOG: 180_000.0}  # return of 30 s
_OF_ENV = {"wheel_legged/standing_still": STANDING, "wheel_legged/moving_forward": FORWARD}
_OF_ENV |= {"wheel_legged_poor/standing_still": POOR}

_SIMULATOR = {"true": ", mended simulator", "posterior": ", posterior", "": ""}  # by the option mend
SUFFIXES = {value: suffix for suffix, value in MEND.items()}


def title_of(name: str) -> str:
    """Return the name in tables and figures of one in the grid's METHODS."""
    method, suffix = split_suffix(name)
    return ALL_METHODS[method].title.removesuffix(" in the simulator") + _SIMULATOR[MEND[suffix]]


TITLES = {name: title_of(name) for name in METHODS}
NOTES = (
    "A cell: return in reality, mean ± standard deviation over seeds; seconds balanced of 30 s; when moving forward, "
    "mean speed (target 0.2 m/s); number of seeds.",
    "The return of 30 s without a fault is 180,000 (standing still) and 90,000 (moving forward).",
    "All methods and seeds have the same real data: the first seconds of the recording; 83 s is all of it, 82.94 s.",
    "SAC uses no real data except for the normalisation of its observations. It is run once per task and seed, with "
    "the normalisation of the whole recording, and stands in every column.",
    "Mended simulator: the effects that close_the_loop found in the same real data are added to it before training.",
    "Posterior: the same, in ten worlds; in each of them, the effects are drawn from the report's intervals and "
    "alternatives.",
)


@dataclass(frozen=True)
class Run:
    """One run in reality.

    Args:
        seed: the run's seed.
        value: its return.
        seconds: seconds balanced, the mean length of an episode.
        speed: mean speed forward in m/s; None if it does not have to move.
        is_unmended: whether ``mend`` has added no effect to its simulator.
    """

    seed: int
    value: float
    seconds: float
    speed: float | None
    is_unmended: bool = False


Points = Mapping[str, Mapping[str, Mapping[float, list[Run]]]]


def points_of(rows: Iterable[Row]) -> Points:
    """Arrange the rows of a results file by panel, method (names in the grid's METHODS) and seconds of real data.

    Runs of SAC in the simulator that is not mended are repeated for every amount of data and every panel of their task.

    Raises:
        MixedRunsError: if two runs differ in settings that the figure does not show, or a panel has runs of several
            amounts of data that it does not show.
    """
    points: dict = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    for row in rows:
        method, panel = row["method"] + SUFFIXES.get(row["mend"], ""), _OF_ENV.get(row["env"])
        if method not in METHODS or panel is None or row["mend"] not in SUFFIXES:
            continue
        run = Run(
            int(row["seed"]),
            float(row["return_mean"]),
            float(row["seconds"]),
            _speed(row),
            row.get("effects_added") == "0",
        )
        for where, size in _places(row, method, panel):
            runs = points[where][method][size]
            if any(run.seed == other.seed for other in runs):
                raise MixedRunsError(
                    f"two runs of {method} have seed {run.seed} in the panel {where!r} at {size:g} s: keep runs with "
                    "other settings in another file"
                )
            runs.append(run)
    for panel in (POOR, REAL_LOG):
        if len(sizes := sorted({size for runs in points[panel].values() for size in runs})) > 1:
            raise MixedRunsError(f"the panel {panel!r} shows one amount of real data, but there are runs of {sizes} s")
    return {panel: points[panel] for panel in PANELS if _has_data(points[panel])}


def _has_data(methods: Mapping[str, Mapping]) -> bool:
    """Whether a panel has more than the runs of SAC that are repeated in it."""
    return bool(methods.keys() - {"sac"})


def _speed(row: Row) -> float | None:
    """Return the mean speed of a run that has to move forward, m/s."""
    return float(row["mean_v"]) if row.get("mean_v") and _OF_ENV.get(row["env"]) == FORWARD else None


def _places(row: Row, method: str, panel: str) -> list[tuple[str, float]]:
    """Return the panels and seconds of real data in which a run counts."""
    if method == "sac":
        if row["data_seconds"] or row["data"] != "recorded":
            return []  # not a run of the grid, which runs SAC with the whole recording only
        sizes = {STANDING: SIZES, FORWARD: (SIZES[0], WHOLE)}.get(panel, ())
        others = [(POOR, 30.0), (REAL_LOG, WHOLE)] if panel == STANDING else []
        return [*((panel, size) for size in sizes), *others]
    if row["data"] != "recorded":
        panel = REAL_LOG
    return [(panel, float(row["data_seconds"] or WHOLE))]


def markdown(points: Points) -> str:
    """Format the runs as Markdown, one table per panel with a line per method and a column per amount of real data.

    Args:
        points: from :func:`points_of`.
    """
    lines = []
    for panel, methods in points.items():
        sizes = sorted({size for runs in methods.values() for size in runs})
        head = [panel, *(f"{size:g} s" for size in sizes)]
        lines += ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
        for method in (method for method in METHODS if method in methods):
            cells = [_cell(methods[method].get(size, [])) for size in sizes]
            lines.append("| " + " | ".join([TITLES[method], *cells]) + " |")
        lines.append("")
    return "\n".join([*lines, *NOTES])


def _cell(runs: list[Run]) -> str:
    if not runs:
        return ""
    values = [run.value for run in runs]
    spread = f" ± {statistics.stdev(values):,.0f}" if len(values) > 1 else ""
    parts = [f"{statistics.mean(values):,.0f}{spread}", f"{statistics.mean(run.seconds for run in runs):.1f} s"]
    speeds = [run.speed for run in runs if run.speed is not None]
    if speeds:
        parts.append(f"{statistics.mean(speeds):.2f} m/s")
    if unmended := sum(run.is_unmended for run in runs):
        parts.append(f"nothing added in {unmended}")
    return "; ".join(parts) + f" ({len(runs)})"
