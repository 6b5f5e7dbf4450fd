"""A run's folder from somebody else builds only what this library knows, unless the user trusts it."""

import copy
import json
import subprocess
from types import SimpleNamespace

import pytest
from omegaconf import OmegaConf

from tests.full_disk import full_disk
from tests.residuals.report.made_up_reports import few_pictures, full_report
from tests.small_runs import ROBOT, SMALL, run
from torchrl_h2o.data import DataError
from torchrl_h2o.effects import Gravity
from torchrl_h2o.residuals import Report
from torchrl_h2o.training import run_folder
from torchrl_h2o.training.config_file import load_config, save_config
from torchrl_h2o.training.environments import task_of
from torchrl_h2o.training.run_folder import resumable
from torchrl_h2o.training.targets import TARGETS

CONFIG = {
    "gap": None,
    "gap_strength": None,
    "env": {
        "name": "InvertedPendulum-v5",
        "make": {"_target_": "torchrl.envs.GymEnv", "env_name": "InvertedPendulum-v5"},
        "simulator": [{"_target_": "torchrl_h2o.effects.Gravity", "scale": 2.0}],
        "reality": [],
        "seconds_per_step": 0.04,
    },
}


def saved(folder, changes):
    """Writes the configuration with some entries replaced, by their places."""
    cfg = OmegaConf.create(copy.deepcopy(CONFIG))
    for place, value in changes.items():
        OmegaConf.update(cfg, place, value, force_add=True)
    folder.mkdir(exist_ok=True)
    (folder / "config.yaml").write_text(OmegaConf.to_yaml(cfg))
    return folder


def call(target, *arguments):
    return {"_target_": target, "_args_": list(arguments)}


def test_the_library_s_own_names_are_built(tmp_path):
    task = task_of(load_config(saved(tmp_path, {})))
    assert task.simulator == (Gravity(2.0),)
    assert {"torchrl_h2o.effects.BodyMass", "torchrl_h2o.effects.ResidualForce"} <= TARGETS
    assert not {"torchrl_h2o.effects.Names", "torchrl_h2o.effects.compile_model"} & TARGETS


HARMFUL = [
    "os.system",
    "builtins.print",
    "numpy.savetxt",
    "torchrl_h2o.training.film.os.system",  # a way through the library's own modules
    "torchrl_h2o.training.judging.subprocess.run",
    "torchrl_h2o.data.readers.whole_folder.shutil.rmtree",
    "torchrl_h2o.effects.Gravity.__init__.__globals__",
    "torchrl_h2o.effects.Gravity ",
    "hydra.utils.instantiate",
    ["os", "system"],
    None,
]


@pytest.mark.parametrize("target", HARMFUL)
@pytest.mark.parametrize("place", ["env.make", "env.simulator", "env.reality", "env.reward", "env.behaviour", "mended"])
def test_another_name_is_refused_wherever_it_stands(tmp_path, place, target):
    node = {"_target_": target, "_partial_": True}
    folder = saved(tmp_path, {place: [node] if place in ("env.simulator", "env.reality") else node})
    with pytest.raises(DataError, match="is not one of this library's effects, envs") as caught:
        load_config(folder)
    assert str(caught.value).count("\n") == 0
    assert f"add trust=[{target}]" in str(caught.value)


@pytest.mark.parametrize(
    "node",
    [
        {"_target_": "torchrl_h2o.effects.Gravity", "scale": call("os.getpid")},
        {"_target_": "torchrl_h2o.effects.Gravity", "_args_": [[{"a": call("os.getpid")}]]},
        {"_target_": "torchrl_h2o.effects.Gravity", "_recursive_": False, "scale": call("os.getpid")},
    ],
)
def test_a_name_inside_the_arguments_of_a_known_one_is_refused(tmp_path, node):
    with pytest.raises(DataError, match=r"os\.getpid"):
        load_config(saved(tmp_path, {"env.reality": [node]}))


def test_nothing_is_called_before_the_refusal_and_trust_allows_it(tmp_path):
    """The call is one that Hydra's own list of refused names does not contain."""
    evidence = tmp_path / "evidence"
    folder = saved(tmp_path / "run", {"env.reality": [call("numpy.savetxt", str(evidence), [1.0])]})
    for trust in (None, False, [], "numpy.loadtxt", ["torchrl_h2o"]):
        with pytest.raises(DataError):
            task_of(load_config(folder, trust=trust))
    assert not evidence.exists()
    for trust in (True, "numpy.savetxt", ["numpy.savetxt"]):
        task_of(load_config(folder, trust=trust))
        evidence.unlink()


def test_all_refused_names_are_listed_at_once(tmp_path):
    folder = saved(tmp_path, {"env.make": call("my_package.Env"), "env.reality": [call("my_package.Wind")]})
    with pytest.raises(DataError, match=r"add trust=\[my_package.Env,my_package.Wind\]"):
        load_config(folder)
    load_config(folder, trust=["my_package.Env", "my_package.Wind"])


def test_an_interrupted_run_of_an_own_env_names_what_to_trust(tmp_path):
    folder = saved(tmp_path, {"env.make": call("my_package.Env")})
    with pytest.raises(SystemExit, match=r"resume=.* 'trust=\[my_package.Env\]'"), resumable(folder):
        raise KeyboardInterrupt


@pytest.mark.parametrize(("typed", "expected"), [(None, None), ("mine.csv", "mine.csv")])
def test_a_resumed_folder_names_no_file_to_write_to(compose, tmp_path, monkeypatch, typed, expected):
    cfg, _ = compose()
    cfg.results = str(tmp_path / ".bash_profile")
    folder = tmp_path / "run"
    folder.mkdir()
    save_config(cfg, folder)
    this_call = SimpleNamespace(
        runtime=SimpleNamespace(output_dir=str(folder)), overrides=SimpleNamespace(task=[f"resume={folder}"])
    )
    monkeypatch.setattr(run_folder.HydraConfig, "get", lambda: this_call)
    resumed, _ = run_folder.open_run(OmegaConf.create({"resume": str(folder), "results": typed, "trust": False}))
    assert resumed.results == expected


def test_names_of_this_call_are_allowed(tmp_path):
    folder = saved(tmp_path, {"env.reality": [call("my_package.MyEffect")]})
    typed = OmegaConf.create({"env": {"reality": [call("my_package.MyEffect")], "reward": "${oc.env:HOME}"}})
    assert load_config(folder, typed=typed).env.reality[0]["_target_"] == "my_package.MyEffect"
    with pytest.raises(DataError):
        load_config(folder, typed=OmegaConf.create({"env": {"reality": [call("my_package.Other")]}}))


@pytest.mark.parametrize("trust", [None, True])
def test_values_that_are_computed_are_refused(tmp_path, trust):
    for value in ("${oc.env:HOME}", "a ${now:%Y}", "${env.name}", "${oc.create:{_target_: os.system}}"):
        with pytest.raises(DataError, match="computed when it is read"):
            load_config(saved(tmp_path, {"env.seconds_per_step": value}), trust=trust)


@pytest.mark.parametrize(
    "arguments",
    [
        {"env_name": "antigravity:Walker2d-v5"},
        {"_args_": ["this:A-v0"]},
        {"env_name": "A-v0", "backend": "antigravity"},
    ],
)
def test_an_env_that_would_import_a_module_is_refused(tmp_path, arguments):
    make = {"_target_": "torchrl.envs.GymEnv", **arguments}
    cfg = copy.deepcopy(CONFIG)
    cfg["env"]["make"] = make
    (tmp_path / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(cfg)))
    with pytest.raises(DataError, match="may import a module"):
        load_config(tmp_path)


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("collector.init.address", "ray://elsewhere:10001"),
        ("collector.init.runtime_env", {"py_executable": "touch evidence"}),
        ("collector.resources.runtime_env", {"py_executable": "touch evidence"}),
    ],
)
def test_a_cluster_or_a_program_that_the_folder_names_is_refused(tmp_path, place, value):
    folder = saved(tmp_path, {place: value})
    with pytest.raises(DataError, match="of Ray starts programs or connects"):
        load_config(folder)
    load_config(folder, trust=[place])
    load_config(saved(tmp_path, {"collector.init": {"address": None, "logging_level": "error"}}))


@pytest.fixture(scope="module")
def report_file(tmp_path_factory):
    return few_pictures(full_report()).save(tmp_path_factory.mktemp("report"))


@pytest.mark.parametrize("effect", [{"effect": "os.system"}, {"_target_": "os.system"}, {"effect": "Effect"}, {}])
def test_a_report_names_effects_only(report_file, tmp_path, effect):
    entries = json.loads(report_file.read_text())
    entries["effects"][0]["effect"] = effect
    (tmp_path / "report.json").write_text(json.dumps(entries))
    with pytest.raises(DataError, match="there is no effect named"):
        Report.load(tmp_path)


def test_a_full_disk_leaves_the_earlier_configuration(tmp_path):
    save_config(OmegaConf.create(CONFIG), tmp_path)
    with full_disk(10), pytest.raises(OSError, match="too large"):
        save_config(OmegaConf.create(CONFIG | {"more": 1}), tmp_path)
    assert "more" not in load_config(tmp_path)


@pytest.mark.slow
def test_the_commands_refuse_a_foreign_folder_in_one_line_and_trust_is_an_option(command, tmp_path):
    """An own env that the user typed trains; its folder is refused in later calls until the user trusts the name."""
    (tmp_path / "my_package.py").write_text(
        "import pathlib\nfrom torchrl_h2o.envs import WheelLeggedEnv\n\n\n"
        "def my_env(**arguments):\n    pathlib.Path('built').touch()\n    return WheelLeggedEnv(**arguments)\n"
    )

    def with_module(*overrides, **kwargs):
        options = command(*overrides, **kwargs)
        return options | {"env": options["env"] | {"PYTHONPATH": f"{tmp_path}:{options['env'].get('PYTHONPATH', '')}"}}

    own = "env.make._target_=my_package.my_env"
    run(with_module(*SMALL, *ROBOT, own, "updates=20", "hydra.run.dir=out"))
    (tmp_path / "built").unlink()
    evaluating, resuming = ("checkpoint=out", "episodes=1", "film=null"), ("resume=out",)
    for overrides, script in ((evaluating, "evaluate.py"), (resuming, "h2o_plus.py"), (resuming, "train.py")):
        done = subprocess.run(**with_module(*overrides, script=script), text=True, check=False)
        assert done.returncode == 1
        (line,) = done.stdout.strip().splitlines()
        assert "out/config.yaml, column 'env.make': _target_ 'my_package.my_env' is not one of this library's" in line
        assert line.endswith("add trust=[my_package.my_env]")
        assert not (tmp_path / "built").exists()
        if script != "train.py":
            run(with_module(*overrides, "trust=[my_package.my_env]", script=script))
            (tmp_path / "built").unlink()
