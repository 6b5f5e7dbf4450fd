"""Finds what the unmodified task lacks in each target file of OTDF, and compares it with the change that was made.

python recipes/benchmarks/off_dynamics.py folder_of_data=datasets      # 18 files, some minutes each
python recipes/benchmarks/off_dynamics.py folder_of_data=datasets files=[walker2d_gravity_0.5_expert]

folder_of_data is the folder datasets/ of github.com/dmksjfl/OTDF. The searches are those of a training with mend=true,
which reuses them. Writes a record of each file to outputs/benchmark/off_dynamics, and skips those that the same commit
has recorded there.
"""

import shutil
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from options import read_options, run_options
from tensordict import TensorDictBase
from tqdm import tqdm

import torchrl_h2o.quiet  # noqa: F401  (before the packages that it keeps quiet)
from torchrl_h2o.commands.one_line_errors import one_line_errors
from torchrl_h2o.comparison.grids import OFF_DYNAMICS_FILES, env_of_file
from torchrl_h2o.comparison.records import Record, read_records
from torchrl_h2o.envs.task_rules import TaskRules, rules_of
from torchrl_h2o.provenance import cpu_seconds
from torchrl_h2o.residuals import Simulation, simulate_transitions
from torchrl_h2o.training.environments import task_of
from torchrl_h2o.training.mending import find_missing_effects, report_of_run

TABLE = "off_dynamics"
POSITIONS = 8  # of the observations of HalfCheetah and Walker2d: z, pitch, six joints; then the velocities, with x


def errors(simulation: Simulation, real: TensorDictBase) -> list[float]:
    """Medians of the absolute errors of the velocities one step ahead: x and z in m/s, pitch and joints in rad/s."""
    error = simulate_transitions(simulation, real) - real["next", "observation"]
    return np.nanmedian(error[:, POSITIONS:].abs().double().numpy(), axis=0).round(5).tolist()


def differences(rules: TaskRules, simulation: Simulation, real: TensorDictBase) -> dict[str, float]:
    """The median error of the rewards in a simulation, and the rows in which the task's rule for a fall disagrees."""
    before, after = (
        np.insert(real[key].double().numpy(), 0, 0.0, axis=1) for key in ("observation", ("next", "observation"))
    )
    actions = real["action"].double().numpy()
    qpos, qvel = np.split(simulation.rollout(before, actions[:, None])[:, 0], [1 + POSITIONS], axis=1)
    steps = np.full(len(real), simulation.control_step)
    error = rules.reward(before[:, : 1 + POSITIONS], qpos, qvel, actions, steps) - real["next", "reward"].numpy()[:, 0]
    fallen = rules.is_terminated(*np.split(after, [1 + POSITIONS], axis=1))
    wrong = fallen != real["next", "terminated"].numpy()[:, 0]
    return {"reward_error": float(np.nanmedian(np.abs(error))), "other_terminations": int(wrong.sum())}


def measure(file: str, folder: Path, to: Path) -> dict[str, Any]:
    """Search one file, and measure the errors of the unmodified, the mended and the changed task."""
    cfg = run_options(f"env={env_of_file(file)}", f"data={folder / file}.hdf5", "mend=true")
    task = task_of(cfg)
    real = task.read_real_data(cfg.data)
    shutil.rmtree(to / "reports" / file, ignore_errors=True)  # it may be an earlier commit's
    find_missing_effects(cfg, task, real, to / "reports" / file)
    report = report_of_run(to / "reports" / file)
    assert report is not None, "a search writes a report, also where it finds nothing"
    unmodified, changed = map(Simulation.from_env, (task.make_simulator(), task.make_reality()))
    return {
        "file": file,
        "change": ", ".join(effect.describe() for effect in task.reality),
        "found": ", ".join(found.words for found in report.found) or report.conclusion or "nothing",
        "verdict": None if report.verdict is None else report.verdict.kind,
        "recommended": report.recommended,
        "why_not": report.why_not_recommended(),
        "sentence": report.sentence(),
        "unmodified": errors(unmodified, real),
        "mended": errors(unmodified.with_effects(*report.effects), real),
        "changed": errors(changed, real),
        **differences(rules_of(gymnasium.make(cfg.env.make.env_name).unwrapped), changed, real),
        "wall_s": report.wall_s,
    }


def main() -> None:
    cfg = read_options(folder_of_data=".", files=list(OFF_DYNAMICS_FILES), folder="outputs/benchmark/off_dynamics")
    torch.set_num_threads(1)
    to = Path(cfg.folder)
    done = {record.name for record in read_records(to, TABLE) if record.is_current}
    for file in tqdm([file for file in cfg.files if file not in done], unit=" files"):
        start = cpu_seconds()
        values = measure(file, Path(cfg.folder_of_data).resolve(), to)
        Record.of_this_process(TABLE, file, values, start).save(to)
        tqdm.write(f"{file}: {values['change']} -> {values['found']}")


if __name__ == "__main__":
    with one_line_errors():
        main()
