"""Replays a trained policy: its returns in reality (or the simulator), and a film or PNG frames of it.

python recipes/evaluate.py checkpoint=outputs/wheel_legged/...                    # reality, with a film
python recipes/evaluate.py checkpoint=... in=simulator episodes=10 film=null
python recipes/evaluate.py checkpoint=... method="SAC in the simulator" film=frames   # a folder of PNG
"""

import torchrl_h2o.quiet  # noqa: F401, I001  (before the packages that it keeps quiet)

import json
from pathlib import Path

import hydra
import torch
from torchrl_h2o.training.environments import make_reality, make_simulator, preprocessing_of, task_of
from torchrl_h2o.training.returns import evaluate
from torchrl_h2o.training.methods import method_named
from omegaconf import DictConfig
from torchrl_h2o.training.film import film
from torchrl_h2o.training.run_folder import checkpoint_folder, keeps_best, load_config
from torchrl.checkpoint import Checkpoint, CheckpointRotation

from torchrl_h2o.objectives import make_actor


def load_policy(cfg: DictConfig, directory: str | Path, method: str = "H2O+") -> torch.nn.Module:
    """The policy that a run's last checkpoint hands over.

    Raises:
        FileNotFoundError: if that method has no checkpoint there.
    """
    latest = CheckpointRotation(checkpoint_folder(directory, method), keep_last=1).latest()
    if latest is None:
        there = sorted(path.name for path in Path(directory, "checkpoints").glob("*"))
        raise FileNotFoundError(f"{directory} has no checkpoint of {method!r}; it has {there or 'none'}")
    env = make_reality(cfg)
    actor = make_actor(env.observation_spec["observation"].shape[-1], env.action_spec_unbatched, cfg.num_cells)
    has_best = "policy" in Checkpoint.manifest(latest)["components"]  # not of a method that has no simulator
    chosen = "policy" if keeps_best(cfg) and has_best else "actor"
    Checkpoint(**{chosen: actor}).load(latest)
    return actor


@hydra.main(config_path="../config", config_name="evaluate", version_base=None)
def main(options: DictConfig) -> None:
    directory = Path(options.checkpoint)
    cfg = load_config(directory)
    worlds = {"reality": make_reality, "simulator": make_simulator}
    if options["in"] not in worlds:
        raise ValueError(f"in={options['in']}: choose reality or simulator")
    make_env = worlds[options["in"]]
    method = options.method or method_named(cfg.get("method", "h2o_plus")).title
    policy = load_policy(cfg, directory, method)
    result = evaluate(make_env(cfg, options.episodes), policy, options.episodes, options.seed)
    seconds = [round(length * cfg.env.seconds_per_step, 2) for length in result.lengths]
    print(f"{method} in {options['in']}: return {result.mean:.1f} ± {result.std:.1f}, episodes of {seconds} s")
    summary = {"method": method, "in": options["in"], "seed": options.seed, **result.summary()}
    (directory / "evaluation.json").write_text(json.dumps(summary | {"returns": result.returns}, indent=2) + "\n")
    if options.film is not None:
        path = directory / options.film
        film(
            task_of(cfg),
            preprocessing_of(cfg),
            policy,
            path,
            simulator=options["in"] == "simulator",
            seconds=options.seconds,
        )
        print(f"look at {path}")


if __name__ == "__main__":
    main()
