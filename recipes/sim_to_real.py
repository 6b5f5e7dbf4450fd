"""Goes round between a simulator and reality: mend, train, predict, run, compare. Each run's log joins the data.

python recipes/sim_to_real.py                              # the wheel-legged robot; its reality is simulated too
python recipes/sim_to_real.py env=wheel_legged_forward seed=1
python recipes/sim_to_real.py env=halfcheetah gap=gravity data=halfcheetah/medium-replay-v0 updates=20000
python recipes/sim_to_real.py mend=false                         # H2O+ in the simulator as it is
python recipes/sim_to_real.py mend=false method=sac randomise=0.2    # SAC in worlds with all numbers ± 20 %
python recipes/sim_to_real.py resume=outputs/sim_to_real/...     # continue an interrupted run

Round 1 has the simulator of the data sheet and `data_seconds` of measured data. For a robot of your own, replace
`run_in_reality` by what runs a policy on it and reads its log.
"""

import torchrl_h2o.quiet  # noqa: F401, I001  (before the packages whose warnings it silences)

import json
import os
from pathlib import Path

import numpy as np
import torch
from omegaconf import DictConfig

from torchrl_h2o.commands.hydra_main import hydra_main
from torchrl_h2o.effects import effect_to_dict
from torchrl_h2o.envs import mujoco_model
from torchrl_h2o.options import SimToRealOptions
from torchrl_h2o.provenance import provenance
from torchrl_h2o.residuals.report.words import effect_words
from torchrl_h2o.training.config_file import save_config
from torchrl_h2o.training.environments import measure_observation_norm, task_of
from torchrl_h2o.training.judging import run_settings
from torchrl_h2o.training.loop import train
from torchrl_h2o.training.mending import find_missing_effects, report_of_run
from torchrl_h2o.training.methods import METHODS
from torchrl_h2o.training.randomisation import usual_world
from torchrl_h2o.training.rounds import (
    Round,
    draw_rounds,
    predict_return,
    run_in_reality,
    table_of_rounds,
    what_is_lacking,
)
from torchrl_h2o.training.run_folder import claimed, open_run, resumable
from torchrl_h2o.whole_file import write_text


@hydra_main("config", "sim_to_real", SimToRealOptions)
def main(cfg: DictConfig) -> None:
    cfg, folder = open_run(cfg)
    with claimed(folder), resumable(folder):
        go_round(cfg, folder)


def go_round(cfg: DictConfig, folder: Path) -> None:
    """Writes rounds.json, rounds.png, and for each round its report, its policy and its log of reality."""
    # The first data: a few seconds, measured under whatever controller the machine has
    first = task_of(cfg).read_real_data(cfg.data, cfg.columns, cfg.data_seconds)
    logs, rounds = [first.set("log", torch.zeros(len(first), dtype=torch.int64))], []
    dt = cfg.env.seconds_per_step
    cfg.env.make.max_episode_steps = round(cfg.seconds / dt)
    measure_observation_norm(cfg, first)
    task, report = task_of(cfg), None

    for number in range(1, cfg.rounds + 1):
        own, here, real = cfg.copy(), folder / f"round_{number}", torch.cat(logs)
        here.mkdir(exist_ok=True)

        # Close the loop on all logs so far; each simulated world gets its own draw of what they leave open
        own.mended = find_missing_effects(own, task, real, here, known=report.effects if report else ())
        if cfg.randomise:
            model, rng = mujoco_model(task.make_simulator()), np.random.default_rng([cfg.seed, number])
            worlds = [usual_world(model, rng, cfg.randomise) for _ in range(cfg.num_worlds)]
            own.mended = {"effects": [], "worlds": [list(map(effect_to_dict, world)) for world in worlds]}

        # Train there, from the last round's policy on
        if number > 1 and cfg.warm_start:
            own.warm_start = str(folder / f"round_{number - 1}")
        save_config(own, here)
        policy, _ = train(METHODS[own.method], own, real, here)

        # Predict the return in reality, run the policy there, and compare
        predicted = predict_return(own, policy, here)
        log = run_in_reality(own, policy, here, real)
        report = report_of_run(here) if own.mended else None
        done = Round(
            seconds=len(real) * dt,
            found=tuple(effect_words(effect) for effect in report.effects) if report else (),
            predicted=predicted.mean,
            low=min(predicted.returns),
            high=max(predicted.returns),
            measured=float(log["next", "reward"].sum()),
            lasted=len(log) * dt,
        )
        if not done.is_inside:
            done = done.lacking(what_is_lacking(own, real, log))
        logs.append(log)
        rounds.append(done)

        # Results
        title = f"{cfg.env.name}: {METHODS[cfg.method].title}" + (", mended in each round" if cfg.mend else "")
        entries = {**run_settings(cfg, first), "method": cfg.method, "randomise": cfg.randomise, "updates": cfg.updates}
        entries |= {"rounds": [one.to_json() for one in rounds]} | provenance()
        write_text(folder / "rounds.json", json.dumps(entries, indent=2) + "\n")
        draw_rounds(folder / "rounds.png", rounds, title)
        print(table_of_rounds(rounds), flush=True)

    shown = os.path.relpath(folder)
    print(f"\nresults    {shown}/rounds.json, round_*/mended/report.html\nlook at    {shown}/rounds.png")
    print(f"replay     python recipes/evaluate.py checkpoint={shown}/round_{cfg.rounds}")


if __name__ == "__main__":
    main()
