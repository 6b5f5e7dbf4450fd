"""The tables of the pages in this folder, each a function from the stored runs, by table, to Markdown."""

from collections.abc import Callable

import numpy as np
from cells import NOT_RUN, Runs, machines, share
from search_tables import (
    audit_table,
    coverage_table,
    drawn_table,
    draws_of,
    failures_table,
    machines_table,
    sources_table,
)
from training_tables import (
    by_seed_table,
    off_dynamics_errors_table,
    off_dynamics_table,
    randomization_table,
    ratio_table,
    rounds_table,
    speed_table,
    training_table,
    trainings_of,
)

from torchrl_h2o.comparison.grids import OFF_DYNAMICS_FILES
from torchrl_h2o.comparison.markdown import markdown_table
from torchrl_h2o.comparison.seed_table import EPISODE


# The overview
def overview_table(runs: Runs) -> str:
    draws, trainings = draws_of(runs), trainings_of(runs)
    held, stands = draws.loc[draws["held"], "ok"], trainings["seconds"] >= EPISODE
    stands = stands[trainings["env"].astype(str).str.startswith("wheel_legged")]
    rows = [
        ["machines", "what it finds in logs of machines", f"{len(runs.get('machines', ()))} of {len(machines())} run"],
        ["drawn", "how often it is right", f"{share(held.sum(), len(held))} draws held back" if len(held) else NOT_RUN],
        ["failures", "where it fails", f"{len(draws) - draws['ok'].sum()} of {len(draws)} draws"],
        ["intervals", "whether its intervals are right", _covered(runs)],
        [
            "training",
            "training",
            f"robot stands in {share(stands.sum(), len(stands))} runs" if len(stands) else NOT_RUN,
        ],
        [
            "randomization",
            "whether measured ranges help a policy",
            f"{len(runs['randomization'])} policies" if "randomization" in runs else NOT_RUN,
        ],
        [
            "sim_to_real",
            "rounds between simulator and reality",
            f"{len(runs['sim_to_real'])} runs" if "sim_to_real" in runs else NOT_RUN,
        ],
        ["off_dynamics", "a benchmark of others", _mended_exactly(runs)],
    ]
    return markdown_table(
        ["page", "what is in it", "now"], [[f"[{page}.md]({page}.md)", *rest] for page, *rest in rows]
    )


def _covered(runs: Runs) -> str:
    if "coverage" not in runs:
        return NOT_RUN
    told = runs["coverage"]
    return f"{share(told['truths_inside'].sum(), told['truths'].sum())} true values inside"


def _mended_exactly(runs: Runs) -> str:
    if "off_dynamics" not in runs:
        return NOT_RUN
    told = runs["off_dynamics"].to_dict("records")
    exact = sum(all(np.less_equal(run["mended"], run["changed"])) for run in told)  # errors one step ahead
    return f"{exact} of {len(told)} simulators mended exactly, {len(OFF_DYNAMICS_FILES)} files"


TABLES: dict[str, Callable[[Runs], str]] = {
    "overview": overview_table,
    "machines": machines_table,
    "sources": sources_table,
    "drawn": drawn_table,
    "audit": audit_table,
    "failures": failures_table,
    "coverage": coverage_table,
    "training": training_table,
    "by_seed": by_seed_table,
    "rounds": rounds_table,
    "speed": speed_table,
    "ratio": ratio_table,
    "randomization": randomization_table,
    "off_dynamics": off_dynamics_table,
    "off_dynamics_errors": off_dynamics_errors_table,
}
