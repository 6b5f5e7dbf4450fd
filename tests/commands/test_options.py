"""Wrong options end a command with one line, before any work and without files; right ones pass."""

import importlib
import re
import sys
from pathlib import Path

import pytest
import torch
from hydra.core.plugins import Plugins
from hydra.core.singleton import Singleton
from omegaconf import OmegaConf, open_dict
from pydantic import ValidationError

from tests.composed import COMMANDS, RECIPES, ROOT, composed
from torchrl_h2o.comparison.options import PaperOptions, ReportOptions
from torchrl_h2o.effects import PAPER_GAPS
from torchrl_h2o.options import (
    CloseTheLoopOptions,
    EvaluateOptions,
    RunOptions,
    TrainOptions,
    check_options,
)
from torchrl_h2o.options.defaults import described
from torchrl_h2o.options.run import MakeOptions
from torchrl_h2o.training.methods import METHODS

GAPS = ", ".join(PAPER_GAPS)
COUNT = "must be an integer of at least 1"
NOWHERE = "there is no such file or folder"
SHARED = "because all worlds share the steps equally"
NOT_A_RUN = "it is not the folder of a run, which has a config.yaml"

METHOD_NAMES = ", ".join(METHODS)
VALUES = {
    "updates=0": f"updates=0: {COUNT}",
    "updates_per_epoch=0": f"updates_per_epoch=0: {COUNT}",
    "eval_every=0": f"eval_every=0: {COUNT}",
    "checkpoint_every=0": f"checkpoint_every=0: {COUNT}",
    "steps_per_epoch=0": f"steps_per_epoch=0: {COUNT}",
    "batch_size=8": "batch_size=8: must be two integers of at least 1, [real,simulated], such as [128,128]",
    "seed=-1": "seed=-1: must be an integer from 0 to 4294967295",
    "gamma=1.5": "gamma=1.5: must be a number from 0 to 1",
    "num_cells=[]": "num_cells=[]: must be the sizes, up to 4096, of 1 to 20 layers, such as [256,256]",
    "device=gpu": "device=gpu: must be cpu or cuda",
    "method=h2oplus": f"method=h2oplus: must be {' or '.join(METHOD_NAMES.rsplit(', ', 1))}; did you mean h2o_plus?",
    "gap=gravty": f"gap=gravty: must be {GAPS} or null; did you mean gravity?",
    "data=halfcheetah/medium-repaly-v0": "data=halfcheetah/medium-repaly-v0: there is no such data set on this "
    "machine; did you mean halfcheetah/medium-replay-v0?",
    "backbone=expectil": "backbone=expectil: must be expectile, sparse or exponential; did you mean expectile?",
    "ratio_estimator=pair": "ratio_estimator=pair: must be paper, change or pairs; did you mean pairs?",
    "keep=best": "keep=best: must be last or best_in_simulator",
    "lr=nan": "lr=nan: must be a number above 0",
    "layer_norm=2": "layer_norm=2: must be true or false",
    "change_noise=-1": "change_noise=-1: must be auto or a number of at least 0",
    "compiled=maybe": "compiled=maybe: must be auto, true or false",
    "seeds=[0,1] compiled=true": "compiled=true is for single runs: stacked networks are slower with it, leave it out",
    "num_cells=[9999]": "num_cells=[9999]: must be the sizes, up to 4096, of 1 to 20 layers, such as [256,256]",
    "mend=first": f"mend=first: {NOWHERE}",
    "baselines=[sca]": f"baselines=[sca]: must be a list out of {METHOD_NAMES}; did you mean sac?",
    "par.beta=-1": "par.beta=-1: must be a number of at least 0",
    "dara.clip=0": "dara.clip=0: must be a number above 0",
    "vgdf.share=0": "vgdf.share=0: must be a number above 0 and at most 1",
    "td3_bc.critic_penalty=-1": "td3_bc.critic_penalty=-1: must be a number of at least 0",
    "seeds=4": "seeds=4: must be null or a list of one or more integers from 0 to 4294967295, such as [0,1,2]",
    "seeds=[1,1]": "seeds=[1,1]: 1 is in the population twice; name each value once",
    "seeds=[0,1] method=sac": "method=sac baselines=[]: a population trains h2o_plus alone; use --multirun for other "
    "methods",
    "gap_strength=2": "gap_strength=2.0 belongs to a gap: name one, such as gap=gravity",
    "n_steps=500": "n_steps=500: must be from 1 to 499, less than the 500 steps of each world in an epoch "
    "(steps_per_epoch=2000 of num_worlds=4)",
    "num_worlds=2001": f"num_worlds=2001: steps_per_epoch=2000 must be a multiple of 2001, {SHARED}",
    "num_worlds=3 steps_per_epoch=1000": f"num_worlds=3: steps_per_epoch=1000 must be a multiple of 3, {SHARED}",
    "collector=multi_sync collector.workers=3": "collector.workers=3 num_worlds=4: steps_per_epoch=2000 must be a "
    f"multiple of 12, {SHARED}",
    "mend=posterior collector=multi_sync collector.workers=5 steps_per_epoch=2020": "collector.workers=5 "
    f"mend=posterior num_worlds=10: steps_per_epoch=2020 must be a multiple of 50, {SHARED}",
    "columns=nowhere.yaml": "columns=nowhere.yaml: there is no such file, and the library's layouts are "
    "double_pendulum, simple_pendulum, wheel_legged_moving_forward, wheel_legged_standing_still",
    "mend=report.jsn": f"mend=report.jsn: {NOWHERE}",
    "resume=nowhere": f"resume=nowhere: {NOT_A_RUN}",
    "env.make.max_episode_steps=0": f"env.make.max_episode_steps=0: {COUNT} or null",
    "env=halfcheetah env.make.env_name=HalfCheeta-v5": "env.make.env_name=HalfCheeta-v5: Environment HalfCheeta "
    "doesn't exist. Did you mean: HalfCheetah?",
}
OTHERS = {
    ("train", "update=100"): "no option update; did you mean updates?",
    ("train", "env=halfcheeta"): "env=halfcheeta: must be halfcheetah, halfcheetah_gravity, halfcheetah_kinematic, "
    "halfcheetah_morph, walker2d, walker2d_gravity, walker2d_kinematic, walker2d_morph, wheel_legged, "
    "wheel_legged_forward, wheel_legged_poor or wheel_legged_undeclared; did you mean halfcheetah?",
    ("train", "data=standing_stil.txt"): f"data=standing_stil.txt: {NOWHERE}; did you mean standing_still.txt?",
    ("train", "preset=papr"): "preset=papr: must be paper; did you mean paper?",
    ("train", "collector=multisync"): "collector=multisync: must be multi_sync, ray or sync; did you mean multi_sync?",
    ("train", "env.make.tsk=moving"): "no option env.make.tsk; did you mean env.make.task?",
    ("train", "presets=paper"): "no option presets; did you mean preset?",
    ("train", "+foo=1"): "no option foo; --help lists the options",
    ("train", "num_cells=["): "num_cells=[: cannot be read; write name=value, and quote a value that has special "
    "characters",
    ("train", "gamma=2 lr=0"): "gamma=2: must be a number from 0 to 1; lr=0: must be a number above 0",
    ("h2o_plus", "tau=0"): "tau=0: must be a number above 0 and at most 1",
    ("h2o_plus", "num_worlds=30 steps_per_epoch=1000"): "num_worlds=30: steps_per_epoch=1000 must be a multiple of 30, "
    f"{SHARED}",
    ("h2o_plus", "num_worlds=2001"): f"num_worlds=2001: steps_per_epoch=2000 must be a multiple of 2001, {SHARED}",
    ("h2o_plus", "mend=posterior num_worlds=3 steps_per_epoch=1005"): "mend=posterior num_worlds=10: "
    f"steps_per_epoch=1005 must be a multiple of 10, {SHARED}",
    ("torchrl_h2o.commands.evaluate", "checkpoint=nowhere"): f"checkpoint=nowhere: {NOT_A_RUN}",
    ("torchrl_h2o.commands.evaluate", ""): "checkpoint is missing: write checkpoint=..., the folder of a run",
    ("torchrl_h2o.commands.evaluate", "checkpoint=runs/firts in=realty"): "checkpoint=runs/firts: "
    f"{NOT_A_RUN}; did you mean runs/first?; in=realty: must be reality or simulator; did you mean reality?",
    ("torchrl_h2o.commands.close_the_loop", "data=nowhere.csv"): f"data=nowhere.csv: {NOWHERE}",
    ("torchrl_h2o.commands.close_the_loop", "simulator=robto.xml"): f"simulator.path=robto.xml: {NOWHERE}; did you "
    "mean robot.xml?",
    ("torchrl_h2o.commands.close_the_loop", "simulator=nothing"): "simulator=nothing: must be gymnasium, mjcf or "
    "wheel_legged",
    ("torchrl_h2o.commands.close_the_loop", "simulator.gap_strength=2"): "simulator.gap_strength=2.0 belongs to a gap: "
    "choose one, such as simulator.gap=gravity",
    ("torchrl_h2o.commands.close_the_loop", "catalogue=[Gravty]"): "catalogue=[Gravty]: Gravty: matches no effect; did "
    "you mean Gravity?",
    ("torchrl_h2o.commands.close_the_loop", "held_out=0"): "held_out=0: must be a share of the rows above 0 and below "
    "1, or the names of logs, such as [c.csv]",
    ("torchrl_h2o.commands.close_the_loop", "audit=maybe"): "audit=maybe: must be true, false or warn",
    (
        "paper",
        "table=retuns",
    ): "table=retuns: must be returns, mixing, gaps, methods, off_dynamics or null; did you mean returns?",
    ("paper", "figure=backbone"): "figure=backbone: must be backbones, wheel_legged or null; did you mean backbones?",
    (
        "paper",
        "table=returns methods=[h2oplus]",
    ): f"methods=[h2oplus]: choose {METHOD_NAMES}; did you mean h2o_plus?",
    ("paper", "table=returns device=gpu"): "device=gpu: must be cpu or cuda",
    ("report", "groups=[retuns]"): "retuns: there is no outputs/results/retuns.csv; did you mean returns?",
    ("report", "+references.mine=[0]"): "references={mine: [0]}: must be the returns that score 0 and 100 for each "
    "environment, such as +references.mine=[0,1000]",
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The current folder, with a few files."""
    for name in ("standing_still.txt", "robot.xml", "runs/first/config.yaml"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "minari" / "halfcheetah" / "medium-replay-v0" / "data").mkdir(parents=True)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def refused(folder, monkeypatch, capsys):
    """Call a command; return its line, having checked status, output and files."""
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    Plugins.instance()  # whose configurations are registered once, at their import, and would be lost with the state
    before, state = sorted(folder.rglob("*")), Singleton.get_state()

    def call(module, *overrides):
        command = importlib.import_module(module)
        # Hydra looks for the configuration of an imported module in a package, which recipes/config is not
        config = [] if module.startswith("torchrl_h2o") else ["--config-path", str(RECIPES)]
        monkeypatch.setattr(sys, "argv", [module, *config, *overrides])
        with pytest.raises(SystemExit) as ended:
            getattr(command, "run", command.main)()
        printed = capsys.readouterr()
        assert (ended.value.code, printed.out) == (1, "")
        assert sorted(folder.rglob("*")) == before
        (line,) = printed.err.splitlines()
        return line

    yield call
    Singleton.set_state(state)


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("typed", VALUES)
def test_a_wrong_value_is_named_with_what_is_allowed(typed):
    with pytest.raises(ValueError, match=f"^{re.escape(VALUES[typed])}$"):
        check_options(composed("train", *typed.split()), TrainOptions)


@pytest.mark.parametrize(("module", "typed"), OTHERS)
def test_a_wrong_option_of_any_command_is_one_line_with_what_is_allowed(refused, module, typed):
    assert refused(module, *typed.split()) == f"ValueError: {OTHERS[module, typed]}"


def test_a_wrong_option_of_a_job_of_a_multirun_is_one_line(refused, tmp_path):
    sweep = f"hydra.sweep.dir={tmp_path.parent / 'sweep'}"
    assert refused("train", "-m", "gamma=1.5,2", sweep) == f"ValueError: {VALUES['gamma=1.5']}"


ENVS = [path.stem for path in (ROOT / "torchrl_h2o" / "config" / "env").glob("*.yaml")]


@pytest.mark.parametrize("env", ENVS)
@pytest.mark.parametrize("chosen", [[], ["preset=paper", "collector=multi_sync"], ["collector=ray"]])
def test_the_options_that_ship_with_every_environment_pass(env, chosen):
    check_options(composed("train", f"env={env}", *chosen), TrainOptions)


@pytest.mark.parametrize(
    ("config", "model"), [("h2o_plus", RunOptions), ("paper", PaperOptions), ("report", ReportOptions)]
)
def test_the_options_that_ship_with_the_other_recipes_pass(config, model):
    check_options(composed(config, *(["table=returns"] if config == "paper" else [])), model)


@pytest.mark.parametrize(
    "chosen",
    [[], ["simulator=gymnasium", "simulator.task=Hopper-v5"], ["simulator=mjcf", f"simulator.path={__file__}"]],
)
def test_the_options_that_ship_with_the_commands_pass(chosen, tmp_path):
    check_options(composed("close_the_loop", *chosen, folder=COMMANDS), CloseTheLoopOptions)
    (tmp_path / "config.yaml").touch()
    check_options(composed("evaluate", f"checkpoint={tmp_path}", folder=COMMANDS), EvaluateOptions)


@pytest.mark.parametrize("config", ["h2o_plus", "train"])
@pytest.mark.parametrize("chosen", [["num_worlds=8"], ["mend=posterior", "num_worlds=3"], ["mend=posterior"]])
def test_worlds_that_share_the_steps_of_an_epoch_equally_pass(config, chosen):
    model = {"h2o_plus": RunOptions, "train": TrainOptions}[config]
    check_options(composed(config, "steps_per_epoch=2000", *chosen), model)


def test_help_has_a_line_for_every_option_with_its_default_value_its_meaning_and_what_is_allowed():
    lines = described(TrainOptions).splitlines()
    assert "mixing=0.1: lambda of Eq. (7) (a number from 0 to 1)" in lines
    assert (
        "batch_size=[128,128]: real, simulated (two integers of at least 1, [real,simulated], such as [128,128])"
        in lines
    )
    groups = {"env", "collector", "h2o", "iql", "cql", "td3_bc", "par", "dara", "vgdf"}
    assert {line.partition(":")[0].partition("=")[0] for line in lines} == TrainOptions.model_fields.keys() - groups


def test_the_names_of_methods_are_those_that_there_are():
    schema = TrainOptions.model_json_schema()["properties"]["method"]
    assert schema["enum"] == list(METHODS)


def test_an_environment_of_the_user_may_have_entries_of_its_own_but_no_misspelt_option():
    cfg = composed("train", "+env.colour=red", "+env.make.wheels=2", "updates=${steps_per_epoch}")
    check_options(cfg, TrainOptions)
    with open_dict(cfg):
        cfg.upates = 5  # as a line in env/mine.yaml
    with pytest.raises(ValueError, match=r"^no option upates; did you mean updates\?$"):
        check_options(cfg, TrainOptions)


@pytest.mark.parametrize("name", ["Hopper-v5", "Hopper", "gymnasium.envs.mujoco:Hopper-v5"])
def test_every_name_that_gymnasium_completes_is_a_task(name):
    check_options(
        composed("close_the_loop", "simulator=gymnasium", f"simulator.task='{name}'", folder=COMMANDS),
        CloseTheLoopOptions,
    )


def test_the_configuration_of_a_run_that_was_moved_passes_but_not_with_a_wrong_value():
    cfg = composed("train", "data=recorded")
    with open_dict(cfg):
        cfg.data, cfg.columns, cfg.of_another_recipe = "/moved/elsewhere.txt", "/moved/columns.yaml", 1
    check_options(cfg, TrainOptions, saved=True)
    cfg.gamma = 1.5
    with pytest.raises(ValueError, match=r"^gamma=1\.5: must be a number from 0 to 1$"):
        check_options(cfg, TrainOptions, saved=True)
    check_options(OmegaConf.create({"checkpoint": "moved"}), EvaluateOptions, saved=True)


@pytest.mark.parametrize(
    ("devices", "device", "said"),
    [
        (0, "cuda", "device=cuda: this machine has no CUDA device that torch can use; choose device=cpu"),
        (1, "cuda", None),
        (0, "cpu", None),
    ],
)
@pytest.mark.parametrize("many", [[], ["seeds=[0,1]"]])
def test_a_run_trains_on_a_device_that_this_machine_has(monkeypatch, devices, device, said, many):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: devices > 0)
    cfg = composed("train", *many, f"device={device}")
    if said is None:
        check_options(cfg, TrainOptions)
    else:
        with pytest.raises(ValueError, match=f"^{said}$"):
            check_options(cfg, TrainOptions)
    check_options(cfg, TrainOptions, saved=True)  # a run that was trained on another machine can be evaluated here


def test_a_data_set_that_is_not_on_this_machine_may_be_downloaded_and_several_files_are_data(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    (tmp_path / "mine" / "quiet-v1" / "data").mkdir(parents=True)
    (tmp_path / "a.csv").touch()
    for data in ("D4RL/door/human-v2", "mine/quiet-v1", "mine/quiet-v2", f"[{tmp_path}/a.csv]", f"{tmp_path}/*.csv"):
        check_options(composed("train", f"data={data}"), TrainOptions)
    with pytest.raises(ValueError, match=r"did you mean mine/quiet-v1\?"):
        check_options(composed("train", "data=mine/quite-v1"), TrainOptions)
    with pytest.raises(ValueError, match=f"b.csv: {NOWHERE}; did you mean .*a.csv"):
        check_options(composed("train", f"data=[{tmp_path}/a.csv,{tmp_path}/b.csv]"), TrainOptions)


def test_no_folder_of_the_user_is_removed(refused, tmp_path):
    elsewhere = Path(tmp_path.parent / "empty" / "run")
    elsewhere.parent.mkdir()
    assert refused("train", "gamma=2", f"hydra.run.dir={elsewhere}").startswith("ValueError: gamma=2")
    assert list(elsewhere.parent.iterdir()) == []


def test_a_version_that_gymnasium_has_removed_is_refused_in_one_line():
    with pytest.raises(ValidationError, match="HalfCheetah-v1"):
        MakeOptions.model_validate({"_target_": "torchrl.envs.GymEnv", "env_name": "HalfCheetah-v1"})
