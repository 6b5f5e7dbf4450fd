"""Finds the effects that a simulator lacks from measured data, adds them and reports the remaining error.

close-the-loop                                           # the wheel-legged robot, recorded in simulation
close-the-loop data=standing_still.txt                   # the same simulator with the real robot's log
close-the-loop simulator=HalfCheetah-v5 simulator.gap=gravity data=halfcheetah/medium-replay-v0
close-the-loop simulator=robot.xml data=log.csv columns=log.yaml       # your own model and log
close-the-loop simulator=a.xml data=b.xml                # what one simulator lacks compared with another one
close-the-loop next=outputs/close_the_loop/... simulator=robot.xml data=log.csv columns=log.yaml  # what to record next
close-the-loop plan=robot.xml seconds=20                 # what to record first, and what it would show
close-the-loop --guess data=log.csv simulator=robot.xml                # writes a first log.yaml for you to correct
"""

import os
import re
import shlex
import sys
import time
from contextlib import suppress
from dataclasses import fields, replace
from fnmatch import fnmatchcase
from pathlib import Path

import mujoco
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig
from torchrl.envs import TransformedEnv

from torchrl_h2o.commands.guess import GUESS, guess_columns
from torchrl_h2o.commands.hydra_main import hydra_main
from torchrl_h2o.commands.one_line_errors import one_line_errors
from torchrl_h2o.commands.recording import Recording, read_recording
from torchrl_h2o.data import Audit, DataError, audit
from torchrl_h2o.data.readers.observed import words_of_estimates
from torchrl_h2o.effects import CatalogueEntry, paper_gap
from torchrl_h2o.envs import DynamicsGap
from torchrl_h2o.experiment import Envelope, Experiment, next_experiment, plan_experiment
from torchrl_h2o.experiment.files import COMMANDS, PAGE
from torchrl_h2o.options import CloseTheLoopOptions
from torchrl_h2o.residuals import Report, Simulation, close_the_loop
from torchrl_h2o.residuals.report.export import export
from torchrl_h2o.residuals.report.json_file import write_json
from torchrl_h2o.residuals.report.mended_model import FILE, save_mended_model
from torchrl_h2o.residuals.report.sentence import sentences
from torchrl_h2o.whole_file import whole_files

DESIGN_MINUTES = 1.0  # of the CPU, to design an experiment, unless ``minutes`` is given
PLANNED_STEP = 0.01  # s, control step of a first log, unless ``simulator.control_step`` is given
DRIVEN = {int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)}
OF_DESIGN = ("next", "minutes", "data", *(field.name for field in fields(Envelope)))
FOR_FILES = 0.04  # share of ``minutes`` for writing the report and the mended model


def make_simulation(cfg: DictConfig, recording: Recording) -> Simulation:
    """Build the simulator under test: a task or MJCF file with ``simulator.effects`` and, if given, a gap of the paper.

    Args:
        cfg: the command's configuration.
        recording: measured data, for the coordinates and control step of an MJCF file.

    Raises:
        ValueError: for a recording that does not fit the model.
    """
    effects = [instantiate(effect) for effect in cfg.simulator.effects]
    if cfg.simulator.gap is not None:
        effects.append(paper_gap(cfg.simulator.gap, cfg.simulator.gap_strength))
    if "path" in cfg.simulator:
        names, step = recording.coordinates(cfg.simulator.coordinates), cfg.simulator.control_step
        simulation = Simulation.from_mjcf(cfg.simulator.path, names, step or recording.control_step(), effects)
        recording.check_actuators(simulation.model)
    else:
        simulation = Simulation.from_env(TransformedEnv(instantiate(cfg.simulator.make), DynamicsGap(*effects)))
    return replace(simulation, action_units=recording.action_units)


def chosen_entries(cfg: DictConfig, simulation: Simulation) -> list[CatalogueEntry] | None:
    """Select the catalogue entries whose class names match a pattern in ``catalogue``; None means all entries.

    Raises:
        ValueError: for a pattern that matches no effect.
    """
    if cfg.catalogue is None:
        return None
    patterns = [cfg.catalogue] if isinstance(cfg.catalogue, str) else list(cfg.catalogue)
    entries = simulation.catalogue()
    names = {entry.name: type(entry.effect).__name__ for entry in entries}
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in names.values()):
            raise ValueError(
                f"catalogue={pattern} matches no effect; choose from {', '.join(sorted(set(names.values())))}"
            )
    return [entry for entry in entries if any(fnmatchcase(names[entry.name], pattern) for pattern in patterns)]


@hydra_main("../config", "close_the_loop", CloseTheLoopOptions)
def main(cfg: DictConfig) -> None:
    begin = time.monotonic()
    directory = Path(HydraConfig.get().runtime.output_dir)
    if cfg.plan is not None:
        plan(cfg, directory)
        return
    recording = read_recording(cfg)
    simulation = make_simulation(cfg, recording)
    recording = recording.for_simulation(simulation)
    if cfg.next is not None:
        design(cfg, simulation, recording, directory)
        return
    entries = chosen_entries(cfg, simulation)
    audited = audit_data(cfg, recording, simulation)

    def so_far(unfinished: Report) -> None:
        with suppress(OSError):  # a disk that is full now may have room at the end
            write_json(unfinished, directory)

    report = close_the_loop(
        simulation,
        recording.transitions,
        entries,
        source="; ".join(filter(None, [recording.source, words_of_estimates(recording.estimated)])),
        held_out=recording.reported_on,
        seed=cfg.seed,
        minutes=minutes_left(cfg.minutes, begin),
        audit=audited,
        known=() if cfg.start_from is None else Report.load(cfg.start_from).effects,
        so_far=so_far,
    )
    print_result(report)  # before it is written, because the disk may be full
    with whole_files(directory) as files:
        if report.recommended:
            report = replace(report, mended_model=save_mended_model(simulation, report.effects, files))
        report.save(files)
    if report.mended_model is None or report.mended_model.file is None:
        (directory / FILE).unlink(missing_ok=True)  # of an earlier run, with other effects
    print_files(report, directory)
    if cfg.export is not None:
        files = export(report, simulation, cfg.export)
        print(f"export     {', '.join(str(path) for path in files)}")


def design(cfg: DictConfig, simulation: Simulation, recording: Recording, directory: Path) -> None:
    """Design the experiment that decides what a report leaves open, print what it is expected to show, and write it.

    Raises:
        ValueError: if the report has no effects, the machine does not come to rest, or no commands keep the limits.
    """
    report, minutes = Report.load(cfg.next), cfg.minutes or DESIGN_MINUTES
    write(
        next_experiment(simulation, recording.transitions, report, envelope_of(cfg), minutes=minutes, seed=cfg.seed),
        directory,
    )
    given = [one for one in HydraConfig.get().overrides.task if one.partition("=")[0] not in OF_DESIGN]
    earlier = cfg.data if isinstance(cfg.data, str) else ",".join(cfg.data)
    print(f"then       close-the-loop {shlex.join([*given, f'data=[NEW_LOG,{earlier}]'])}")


def plan(cfg: DictConfig, directory: Path) -> None:
    """Design the commands of a first log for a model, print which effects it would show, and write it.

    Raises:
        ValueError: if a joint has no name, an actuator has no range, the machine does not come to rest, or no commands
            keep the limits.
    """
    simulation = Simulation.from_mjcf(cfg.plan, joints_of(cfg.plan), cfg.simulator.get("control_step") or PLANNED_STEP)
    minutes = cfg.minutes or DESIGN_MINUTES
    write(plan_experiment(simulation, envelope_of(cfg), noise=cfg.noise, minutes=minutes, seed=cfg.seed), directory)


def joints_of(path: str) -> list[str]:
    """Names of the hinges and slides of a model, and of their velocities, as coordinates."""
    model = mujoco.MjModel.from_xml_path(path)
    names = [model.joint(joint).name for joint in range(model.njnt) if int(model.jnt_type[joint]) in DRIVEN]
    if not names or not all(names):
        raise ValueError(f"plan={path}: each hinge and slide needs a name in the model")
    return [*names, *(f"{name}_velocity" for name in names)]


def envelope_of(cfg: DictConfig) -> Envelope:
    """What an experiment may use, by the options."""
    return Envelope(**{field.name: cfg[field.name] for field in fields(Envelope)})


def write(experiment: Experiment, directory: Path) -> None:
    """Write an experiment, and print what it is expected to show."""
    experiment.save(directory)
    folder = os.path.relpath(directory)
    print(f"\n{experiment.words()}\n\ncommands   {folder}/{COMMANDS}\nlook at    {folder}/{PAGE}")


def minutes_left(minutes: float | None, begin: float) -> float | None:
    """Time for the search and its judgement, in minutes, after the time that has passed and that for the files.

    Args:
        minutes: time for the whole command; None for as long as it takes.
        begin: when the command began, in s of the monotonic clock.

    Raises:
        ValueError: if nothing is left.
    """
    if minutes is None:
        return None
    passed = (time.monotonic() - begin) / 60.0
    if (left := (1.0 - FOR_FILES) * minutes - passed) <= 0.0:
        raise ValueError(f"minutes={minutes:g} is too short: reading and auditing the data took {passed:.2g} minutes")
    return left


def audit_data(cfg: DictConfig, recording: Recording, simulation: Simulation) -> Audit | None:
    """Audit the data, print the findings, and stop at severe ones; None with ``audit=false``.

    Raises:
        DataError: for severe findings, unless ``audit=warn``.
    """
    if not cfg.audit:
        return None
    found = audit(recording.transitions, simulation)
    if found.findings:
        print(f"audit of {recording.source}\n{found.words()}\n")
    if found.severe and cfg.audit != "warn":
        first = found.severe[0]
        raise DataError(first.words, f"{first.remedy}; audit=warn goes on all the same", source=recording.source)
    return found


def print_result(report: Report) -> None:
    """Print the result in words, and tables of its effects and errors."""
    print("", *sentences(report), f"\ndata       {report.data.source}", sep="\n")
    if report.found:
        print(f"\n{'the simulator lacks':<48}{'':<14}{'value':>12}  95 % interval")
    for found in report.found:
        for row, (name, symbol, value, (low, high)) in enumerate(found.values):
            unit = "" if symbol == "1" else f" {symbol}"
            label = found.name if row == 0 else ""
            print(f"{label:<47} {name:<14}{value:>12.4g}  {low:.4g} to {high:.4g}{unit}")
    if report.error is not None:
        print(f"\n{report.error.metric}\n{'':<62}{'before':>12}{'after':>12}")
        for dimension in report.error.per_dimension:
            print(f"{dimension.name:<47} {dimension.unit:<14}{dimension.before:>12.3g}{dimension.after:>12.3g}")


def print_files(report: Report, directory: Path) -> None:
    """Print the paths of the files written, and commands that use them."""
    folder = os.path.relpath(directory)
    print(f"\nresults    {folder}/report.json\nreport     {folder}/report.html")
    mended = report.mended_model
    if mended is not None and mended.file is not None:
        print(f"model      {folder}/{mended.file}")
    if mended is not None and mended.left_out:
        where = f"not in {mended.file}" if mended.file else f"no {FILE} ({mended.failure})"
        print(f"           {where}: {'; '.join(left.words for left in mended.left_out)}")
    if report.ended_in is not None and report.found:
        print(f"go on      close-the-loop ... start_from={folder}")
    if report.others or report.indistinguishable:
        print(f"decide     close-the-loop ... next={folder}/report.json")
    if report.recommended:
        print(f"train      python recipes/h2o_plus.py ... mend={folder}/report.json")


def expanded(argument: str) -> list[str]:
    """Expand the short forms ``simulator=robot.xml``, ``plan=robot.xml`` and ``simulator=HalfCheetah-v5`` for Hydra."""
    key, _, name = argument.partition("=")
    if key == "plan" and name:
        return [argument, "simulator=mjcf", f"simulator.path={name}"]
    if key == "simulator" and name.endswith((".xml", ".urdf")):
        return ["simulator=mjcf", f"simulator.path={name}"]
    if key == "simulator" and re.search(r"-v\d+$", name):
        return ["simulator=gymnasium", f"simulator.task={name}"]
    return [argument]


def run() -> None:
    """Entry point of the console command ``close-the-loop``."""
    if GUESS in sys.argv[1:]:
        with one_line_errors():
            guess_columns(sys.argv[1:])
        return
    sys.argv[1:] = [full for argument in sys.argv[1:] for full in expanded(argument)]
    main()


if __name__ == "__main__":
    run()
