"""The results of ``figure=data_size``, arranged by panel, method and seconds of real data, and their table."""

import pandas as pd

from torchrl_h2o.comparison.grids import DATA_SIZE_METHODS, MEND, SIZES, WHOLE, split_suffix
from torchrl_h2o.comparison.markdown import markdown_table
from torchrl_h2o.comparison.scores import MixedRunsError
from torchrl_h2o.training.methods import METHODS

STANDING, FORWARD, POOR = "standing still", "moving forward", "standing still, poor data"
REAL_LOG = "standing still, the real robot's log"
PANELS = (STANDING, FORWARD, POOR, REAL_LOG)
FAULTLESS = {STANDING: 180_000.0, FORWARD: 90_000.0, POOR: 180_000.0, REAL_LOG: 180_000.0}  # return of 30 s
_OF_ENV = {
    "wheel_legged/standing_still": STANDING,
    "wheel_legged/moving_forward": FORWARD,
    "wheel_legged_poor/standing_still": POOR,
}
#: panels and sizes in which a run of SAC counts that uses no real data, by its task
_SAC = {
    STANDING: [*((STANDING, size) for size in SIZES), (POOR, 30.0), (REAL_LOG, WHOLE)],
    FORWARD: [(FORWARD, SIZES[0]), (FORWARD, WHOLE)],
}
_SIMULATOR = {"true": ", mended simulator", "posterior": ", posterior", "": ""}  # by the option mend


def title_of(name: str) -> str:
    """Return the title of a name in :data:`DATA_SIZE_METHODS`, such as "IQL" or "SAC, mended simulator"."""
    method, suffix = split_suffix(name)
    return METHODS[method].title.removesuffix(" in the simulator") + _SIMULATOR[MEND[suffix]]


TITLES = {name: title_of(name) for name in DATA_SIZE_METHODS}  # in tables and figures
NOTES = """\
A cell: return in reality, mean ± standard deviation over seeds; seconds balanced of 30 s; when moving forward, mean \
speed (target 0.2 m/s); number of seeds.
The return of 30 s without a fault is 180,000 (standing still) and 90,000 (moving forward).
All methods and seeds have the same real data: the first seconds of the recording; 83 s is all of it, 82.94 s.
SAC uses no real data except for the normalisation of its observations. It is run once per task and seed, with the \
normalisation of the whole recording, and stands in every column.
Mended simulator: the effects that close_the_loop found in the same real data are added to it before training.
Posterior: the same, in ten worlds; in each, the effects are drawn from the report's intervals and alternatives."""


def points_of(runs: pd.DataFrame) -> pd.DataFrame:
    """Arrange the rows of a results file by panel, method (of the grid's methods) and seconds of real data.

    Runs of SAC in the simulator that is not mended are repeated for every amount of data and every panel of their task.

    Returns:
        A row for each place of a run, with the columns ``panel``, ``method``, ``size`` (s), ``seed``, ``value`` (its
        return), ``share`` (of a faultless episode's, in %), ``seconds`` (balanced), ``speed`` (m/s; NaN if it does not
        have to move) and ``unmended`` (whether ``mend`` has added no effect).

    Raises:
        MixedRunsError: if two runs differ in settings that the figure does not show, or a panel has runs of several
            amounts of data that it does not show.
    """
    suffixes = {value: suffix for suffix, value in MEND.items()}
    rows = []
    for run in runs.to_dict("records"):
        method, panel = run["method"] + suffixes.get(run["mend"], "?"), _OF_ENV.get(run["env"])
        if method not in DATA_SIZE_METHODS or panel is None:
            continue
        recorded = run["data"] == "recorded"
        places = [(panel if recorded else REAL_LOG, float(run["data_seconds"] or WHOLE))]
        if method == "sac":  # the grid has it with the whole recording only
            places = _SAC.get(panel, []) if recorded and not run["data_seconds"] else []
        speed = float(run["mean_v"] or "nan") if panel == FORWARD else float("nan")
        values = (
            int(run["seed"]),
            float(run["return_mean"]),
            float(run["seconds"]),
            speed,
            run["effects_added"] == "0",
        )
        rows += [(where, method, size, *values) for where, size in places]
    columns = ["panel", "method", "size", "seed", "value", "seconds", "speed", "unmended"]
    points = pd.DataFrame(rows, columns=columns)
    for point in points[points.duplicated(["panel", "method", "size", "seed"])].to_dict("records"):
        raise MixedRunsError(
            f"two runs of {point['method']} have seed {point['seed']} in the panel {point['panel']!r} at "
            f"{point['size']:g} s: keep runs with other settings in another file"
        )
    for panel in (POOR, REAL_LOG):
        if len(sizes := sorted(points.loc[points["panel"] == panel, "size"].unique())) > 1:
            raise MixedRunsError(
                f"the panel {panel!r} shows one amount of real data, but there are runs of {list(map(float, sizes))} s"
            )
    with_data = points.loc[points["method"] != "sac", "panel"].unique()
    points = points[points["panel"].isin(with_data)]
    return points.assign(share=100.0 * points["value"] / points["panel"].map(FAULTLESS))


def panels_of(points: pd.DataFrame) -> list[str]:
    """Names of the panels that have runs, in the order of the figure."""
    return [panel for panel in PANELS if (points["panel"] == panel).any()]


def markdown(points: pd.DataFrame) -> str:
    """Format the runs as Markdown, one table per panel with a line per method and a column per amount of real data.

    Args:
        points: from :func:`points_of`.
    """
    parts = []
    for panel in panels_of(points):
        of_panel = points[points["panel"] == panel]
        sizes = sorted(of_panel["size"].unique())
        cells = {key: _cell(runs) for key, runs in of_panel.groupby(["method", "size"])}
        methods = [method for method in DATA_SIZE_METHODS if (of_panel["method"] == method).any()]
        rows = [[TITLES[method], *(cells.get((method, size), "") for size in sizes)] for method in methods]
        parts.append(markdown_table([panel, *(f"{size:g} s" for size in sizes)], rows) + "\n")
    return "\n".join([*parts, NOTES])


def _cell(runs: pd.DataFrame) -> str:
    spread = f" ± {runs['value'].std():,.0f}" if len(runs) > 1 else ""
    parts = [f"{runs['value'].mean():,.0f}{spread}", f"{runs['seconds'].mean():.1f} s"]
    if runs["speed"].notna().any():
        parts.append(f"{runs['speed'].mean():.2f} m/s")
    if unmended := runs["unmended"].sum():
        parts.append(f"nothing added in {unmended}")
    return "; ".join(parts) + f" ({len(runs)})"
