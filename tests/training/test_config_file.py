"""The configuration in a run's folder: what earlier versions did not write is filled in with what they did."""

from omegaconf import open_dict

from torchrl_h2o.options import RunOptions, check_options
from torchrl_h2o.training.config_file import load_config, save_config

FIRST = {  # options of the first version
    "env", "seed", "gap", "gap_strength", "data", "columns", "backbone", "expectile", "value_alpha", "mixing", "ratio",
    "input_noise", "updates", "steps_per_epoch", "updates_per_epoch", "batch_size", "discriminator_batch_size",
    "sim_capacity", "gamma", "num_cells", "lr", "tau", "target_entropy", "threads", "reward_scale",
    "normalise_observation", "observation_norm", "eval_every", "eval_episodes", "final_episodes", "checkpoint_every",
    "render",
}  # fmt: skip
OF_THE_CALL = {"resume", "trust"}  # read from the command line alone


def test_a_folder_of_the_first_version_has_every_option_with_what_that_version_did(compose, tmp_path):
    cfg, _ = compose("eval_episodes=3", config="h2o_plus")
    later = set(cfg) - FIRST - OF_THE_CALL
    with open_dict(cfg):
        for name in later | OF_THE_CALL:
            del cfg[name]
    save_config(cfg, tmp_path)
    loaded = load_config(tmp_path)
    assert set(loaded) == set(RunOptions.model_fields) - OF_THE_CALL
    told = {"action_history": 0, "compiled": False, "data_seconds": None, "n_steps": 1, "layer_norm": False,
            "num_worlds": 1, "keep": "last", "ratio_estimator": "paper", "sim_capacity_min": 1}  # fmt: skip
    assert {name: loaded[name] for name in told} == told
    assert loaded.trial_episodes == loaded.eval_episodes == 3
    assert {name: loaded[name] for name in FIRST} == {name: cfg[name] for name in FIRST}
    check_options(loaded, RunOptions)


def test_options_that_a_folder_has_are_those_of_its_run(compose, tmp_path):
    cfg, _ = compose("action_history=2", "compiled=null", "keep=best_in_simulator", "precision=float32")
    cfg.resume = "here"
    save_config(cfg, tmp_path)
    assert load_config(tmp_path) == cfg
