"""Writes an experiment: commands as CSV, the expected verdict as JSON, and a page to look at."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from torchrl_h2o.experiment.preview import film_motion
from torchrl_h2o.residuals.report import plots
from torchrl_h2o.residuals.report.templates import templates
from torchrl_h2o.residuals.report.words import quantity
from torchrl_h2o.whole_file import whole_files, write_text

if TYPE_CHECKING:
    from torchrl_h2o.experiment.experiment import Experiment

COMMANDS, RESULT, PAGE, FILM = "commands.csv", "experiment.json", "experiment.html", "preview.gif"
PARTING = 0.2  # share of the blocks that the page marks, those in which the predictions differ most


def write_files(experiment: Experiment, folder: Path) -> None:
    """Writes all files; they appear together."""
    folder.mkdir(parents=True, exist_ok=True)
    with whole_files(folder) as files:
        step = experiment.simulator.control_step
        rows = [[index * step, *commands] for index, commands in enumerate(experiment.commands.tolist())]
        lines = [",".join(["time (s)", *_headers(experiment)]), *(",".join(f"{x:.6g}" for x in row) for row in rows)]
        write_text(Path(files) / COMMANDS, "\n".join(lines) + "\n")
        write_text(Path(files) / RESULT, json.dumps(to_json(experiment), indent=2, ensure_ascii=False) + "\n")
        is_filmed = _try_to_film(experiment, Path(files) / FILM)
        write_text(Path(files) / PAGE, page(experiment, FILM if is_filmed else None))


def _try_to_film(experiment: Experiment, path: Path) -> bool:
    """Films the motion of the likeliest explanation. If that fails, writes a message; the other files are complete."""
    try:
        film_motion(experiment.simulator, experiment.states, path)
    except Exception as error:
        tqdm.write(f"no {FILM}: {error}")
        return False
    return True


def _headers(experiment: Experiment) -> list[str]:
    named = zip(experiment.simulator.actuators, _units(experiment), strict=True)
    return [f"{name} ({unit})" if unit else name for name, unit in named]


def _units(experiment: Experiment) -> tuple[str, ...]:
    return tuple(experiment.simulator.action_units) or ("",) * len(experiment.simulator.actuators)


def to_json(experiment: Experiment) -> dict:
    """The expected verdict as plain data."""
    return {
        "seconds": experiment.seconds,
        "control_step": experiment.simulator.control_step,
        "explanations": [list(words) for words in experiment.explanations],
        "told_apart": experiment.told_apart.round(4).tolist(),
        "shown": [asdict(one) for one in experiment.shown],
        "narrowing": [{"value": one.words, "width_after_over_before": one.share} for one in experiment.narrowing],
    }


def page(experiment: Experiment, film: str | None = None) -> str:
    """The page, with its plots embedded, and the film beside it, if there is one."""
    times = np.arange(len(experiment.commands) + 1) * experiment.simulator.control_step
    blocks = experiment.block_seconds * np.arange(len(experiment.nats) + 1)
    most = np.argsort(experiment.nats)[len(experiment.nats) - round(PARTING * len(experiment.nats)) :]
    marked = [(float(blocks[i]), float(blocks[i + 1])) for i in most if experiment.nats[i] > 0.0]
    readings = list(zip(experiment.simulator.state_map.names, experiment.simulator.state_map.units, strict=True))
    motions = [
        plots.motions_in_time(times, experiment.motions[:, :, k], name, unit, marked)
        for k, (name, unit) in enumerate(readings)
        if not name.endswith("_velocity")
    ]
    commands = [
        plots.motions_in_time(times[:-1], experiment.commands[None, :, k], name, unit, ())
        for k, (name, unit) in enumerate(zip(experiment.simulator.actuators, _units(experiment), strict=True))
    ]
    return (
        templates(Path(__file__).parent)
        .get_template("experiment.html.jinja")
        .render(
            experiment=experiment, motions=motions, commands=commands, colours=plots.LINES, quantity=quantity, film=film
        )
    )
