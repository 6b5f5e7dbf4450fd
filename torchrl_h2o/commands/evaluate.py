"""Replays a trained policy: prints its returns in reality or the simulator and writes a film or PNG frames.

The files go into the run's folder, or into the working directory if that folder cannot be written.

h2o-evaluate checkpoint=outputs/wheel_legged/...                    # reality, with a film
h2o-evaluate checkpoint=... in=simulator episodes=10 film=null
h2o-evaluate checkpoint=... method="SAC in the simulator" film=frames   # a folder of PNG files
"""

import json
import os
from pathlib import Path

from omegaconf import DictConfig

from torchrl_h2o.commands.hydra_main import hydra_main
from torchrl_h2o.options import EvaluateOptions
from torchrl_h2o.training.config_file import load_config
from torchrl_h2o.training.environments import make_reality, make_simulator, preprocessing_of, task_of
from torchrl_h2o.training.film import film
from torchrl_h2o.training.methods import METHODS
from torchrl_h2o.training.returns import evaluate
from torchrl_h2o.training.trained_policy import load_policy
from torchrl_h2o.whole_file import write_text

WORLDS = {"reality": make_reality, "simulator": make_simulator}


@hydra_main("../config", "evaluate", EvaluateOptions)
def main(options: DictConfig) -> None:
    directory, world = Path(options.checkpoint), options["in"]
    folder = directory if os.access(directory, os.W_OK) else Path.cwd()
    cfg = load_config(directory, trust=options.trust)
    method = options.method or METHODS[cfg.method].title
    policy = load_policy(cfg, directory, method)
    result = evaluate(WORLDS[world](cfg, options.episodes), policy, options.episodes, options.seed)
    seconds = [round(length * cfg.env.seconds_per_step, 2) for length in result.lengths]
    print(f"{method} in {world}: return {result.mean:.1f} ± {result.std:.1f}, episodes of {seconds} s")
    summary = {"method": method, "in": world, "seed": options.seed, **result.summary()}
    write_text(folder / "evaluation.json", json.dumps(summary | {"returns": result.returns}, indent=2) + "\n")
    if options.film is not None:
        path = folder / options.film
        task, preprocessing = task_of(cfg), preprocessing_of(cfg)
        film(task, preprocessing, policy, path, simulator=world == "simulator", seconds=options.seconds)
        print(f"film: {path}")


def run() -> None:
    """Entry point of the console command ``h2o-evaluate``."""
    main()


if __name__ == "__main__":
    run()
