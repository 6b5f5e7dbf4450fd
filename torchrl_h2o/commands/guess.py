"""Writes a first YAML file for the columns of a log: ``close-the-loop --guess data=log.csv [simulator=robot.xml]``."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import mujoco
from omegaconf import OmegaConf
from yaml import YAMLError

from torchrl_h2o.data import DataError, sources_of
from torchrl_h2o.data.readers.guess.contents import require_several_runs
from torchrl_h2o.data.readers.guess.coordinates import Coordinates
from torchrl_h2o.data.readers.guess.layout import guess_layout
from torchrl_h2o.data.readers.robot_log import read_robot_log
from torchrl_h2o.effects.model.servo import is_servo, is_velocity_servo
from torchrl_h2o.residuals.simulation.model_file import read_model, read_spec
from torchrl_h2o.residuals.simulation.state_map import coordinate_names
from torchrl_h2o.whole_file import write_text

GUESS = "--guess"


def guess_columns(arguments: Sequence[str]) -> None:
    """Writes the guessed layout of a log, and prints what to do next.

    Args:
        arguments: ``--guess``, ``data=``, and optionally ``simulator=``, an MJCF file whose joints are matched, and
            ``columns=``, the file to write: by default the log's name with the suffix .yaml, in the working directory.

    Raises:
        ValueError: for missing or other arguments, or a file that is not a model.
        torchrl_h2o.data.DataError: if the log cannot be read as a table, several logs are columns of one run, or the
            file to write exists or cannot be written.
    """
    given = {name: value for name, _, value in (argument.partition("=") for argument in arguments if argument != GUESS)}
    unknown = [name for name in given if name not in ("data", "simulator", "columns")]
    if unknown or "data" not in given:
        problem = f"{unknown[0]} is not an option of --guess" if unknown else "the log is missing"
        raise ValueError(
            f"{problem}; write close-the-loop --guess data=log.csv [simulator=robot.xml] [columns=log.yaml]"
        )
    data = given["data"]
    if data.startswith("{"):
        try:
            logs = sources_of(dict(OmegaConf.create(data)))
        except YAMLError:
            raise ValueError(f"data={data} is no mapping; write 'data={{position: a.csv, effort: b.csv}}'") from None
    else:
        logs = sources_of([part.strip() for part in data.strip("[]").split(",")])
    require_several_runs(logs)
    log = logs[0]
    path = Path(given.get("columns", f"{Path(log).stem}.yaml"))
    text = guess_layout(log, _coordinates_of(given["simulator"]) if "simulator" in given else None)
    if path.exists():
        problem = "the file exists and is not overwritten"
        raise DataError(problem, "remove it, or choose another name with columns=", source=path)
    try:
        write_text(path, text)
    except OSError as error:
        problem = f"the file cannot be written: {error.strerror or error}"
        raise DataError(problem, "choose another name with columns=", source=path) from error
    words = [f"simulator={given.get('simulator', 'robot.xml')}", f"data={given['data']}", f"columns={path}"]
    print(f"{path} describes the columns of {log}; correct it, then run\n\n{shlex.join(['close-the-loop', *words])}")
    try:
        read_robot_log(log, path)
    except DataError as error:
        print(f"\nNot yet readable: {error}")


def _coordinates_of(simulator: str) -> Coordinates:
    try:
        model, spec = read_model(Path(simulator)), read_spec(Path(simulator))
    except ValueError as error:
        raise ValueError(f"simulator={simulator}: {error}") from None
    names, units = coordinate_names(model)
    joints = [model.joint(i).name for i in range(model.njnt)]
    return Coordinates(
        dict(zip(names, units, strict=True)),
        [model.actuator(i).name or str(i) for i in range(model.nu)],
        servos=_servos(spec),
        forces=model.nu > 0 and all(_pushes(model, actuator) for actuator in range(model.nu)),
        driven={
            model.actuator(i).name or str(i): joints[model.actuator_trnid[i, 0]]
            for i in range(model.nu)
            if model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
        },
        ranges={name: tuple(model.jnt_range[i]) for i, name in enumerate(joints) if model.jnt_limited[i]},
    )


def _servos(spec: mujoco.MjSpec) -> Literal["position", "velocity"] | None:
    """What the commands of the actuators are, if all are servos of one kind."""
    if not spec.actuators:
        return None
    if all(map(is_servo, spec.actuators)):
        return "position"
    return "velocity" if all(map(is_velocity_servo, spec.actuators)) else None


def _pushes(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator exerts a force: on a sliding joint, or on a site along an axis."""
    kind, target = mujoco.mjtTrn(model.actuator_trntype[actuator]), int(model.actuator_trnid[actuator, 0])
    if kind in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT):
        return model.jnt_type[target] == mujoco.mjtJoint.mjJNT_SLIDE
    return kind == mujoco.mjtTrn.mjTRN_SITE and bool(model.actuator_gear[actuator, :3].any())
