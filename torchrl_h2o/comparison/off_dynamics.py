"""The results of ``table=off_dynamics``: scores by file and method, and how often the mended simulator wins."""

from collections.abc import Mapping
from pathlib import Path

import pandas as pd

from torchrl_h2o.comparison.grids import MENDED, OFF_DYNAMICS_FILES, OFF_DYNAMICS_METHODS, env_of_file
from torchrl_h2o.comparison.markdown import markdown_table
from torchrl_h2o.comparison.scores import REFERENCES, MixedRunsError, normalised
from torchrl_h2o.training.methods import METHODS

ASKED = 80.0  # score that the mended simulator is to reach with half of the gravity
GRAVITY = "gravity"
NOTES = """\
Scores in the changed task, 0 for a random policy and 100 for the expert of the data's authors: mean ± standard
deviation over seeds (number of seeds). In the mended simulator, the effects that close_the_loop found in the same file
are added before training; the run begins at the behaviour in the data and keeps the policy that is best there. The
other methods are as published. SAC reads no data, so one run per change and seed stands in the rows of all three
files. An empty cell was not run.

The published numbers of other methods for these files are of another setting: their source is offline data of the
unmodified task, and they have no simulator that they could adjust. Of ODRL's settings, "online source, offline target"
is the fair one to compare with: all columns here have it, and the simulator's parameters can be set besides."""


def title_of(name: str) -> str:
    """Return the title of a name in :data:`OFF_DYNAMICS_METHODS`, such as "IQL" or "SAC, mended simulator"."""
    title = METHODS[name.removesuffix(MENDED)].title.removesuffix(" in the simulator")
    return title + (", mended simulator" if name.endswith(MENDED) else "")


def points_of(runs: pd.DataFrame) -> pd.DataFrame:
    """Arrange the rows of a results file by file, method (of the grid's methods), seed and score.

    Raises:
        MixedRunsError: if runs differ in their number of updates, or a method has two runs of a seed.
    """
    rows = []
    for run in runs.to_dict("records"):
        method, env = run["method"] + {"": "", "true": MENDED}.get(run["mend"], "?"), run["env"]
        own = [Path(run["data"]).stem] if method != "sac" else [f for f in OFF_DYNAMICS_FILES if env_of_file(f) == env]
        score = normalised(float(run["return_mean"] or "nan"), REFERENCES[env])
        rows += [(file, method, int(run["seed"]), score) for file in own]
    points = pd.DataFrame(rows, columns=["file", "method", "seed", "score"])
    if runs["updates"].nunique() > 1 or points.duplicated(["file", "method", "seed"]).any():
        raise MixedRunsError("off_dynamics: runs differ in updates or in other options: keep each kind in its own file")
    return points


def markdown(points: pd.DataFrame, found: Mapping[str, Mapping[str, str]] | None = None) -> str:
    """Format a table with a line for each file and a column for each method, and count where the mended simulator wins.

    Args:
        points: from :func:`points_of`.
        found: by file, further columns to show first; files without scores are shown as well.
    """
    means = points.groupby(["file", "method"])["score"].mean().unstack().reindex(columns=list(OFF_DYNAMICS_METHODS))
    cells = {key: _cell(scores) for key, scores in points.groupby(["file", "method"])["score"]}
    named = found or {}
    files = [file for file in OFF_DYNAMICS_FILES if file in named or file in means.index]
    columns = list(next(iter(named.values()), {}))
    rows = [
        [
            file,
            *(named.get(file, {}).get(column, "") for column in columns),
            *(cells.get((file, method), "") for method in OFF_DYNAMICS_METHODS),
        ]
        for file in files
    ]
    head = ["file", *columns, *map(title_of, OFF_DYNAMICS_METHODS)]
    complete = means.dropna()
    return "\n\n".join([markdown_table(head, rows), *([_count(complete)] if len(complete) else []), NOTES])


def _count(complete: pd.DataFrame) -> str:
    """Say in how many of the files with all methods the mended simulator wins; ``complete`` has their mean scores."""
    mended = [method for method in complete if method.endswith(MENDED)]
    best, others = complete[mended].max(axis=1), complete.drop(columns=mended).max(axis=1)
    lines = [f"The better of {' and '.join(map(title_of, mended))} beats the best of the others in"]
    lines += [f"{(best > others).sum()} of {len(complete)} files; H2O+ in the mended simulator alone in"]
    lines += [f"{(complete['h2o_plus' + MENDED] > others).sum()}. The better one scores {ASKED:g} or more in"]
    halved = best[[GRAVITY in str(file) for file in best.index]]
    return " ".join([*lines, f"{(halved >= ASKED).sum()} of {len(halved)} files with half of the gravity."])


def _cell(scores: pd.Series) -> str:
    if scores.isna().any():
        return f"diverged in {scores.isna().sum()} of {len(scores)}"
    spread = f" ± {scores.std():.1f}" if len(scores) > 1 else ""
    return f"{scores.mean():.1f}{spread} ({len(scores)})"
