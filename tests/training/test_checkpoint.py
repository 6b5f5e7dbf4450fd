"""Checkpoints that are damaged, or made by somebody: refused in one line that names the file, and nothing is run."""

import os
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from tests.fuzzing import changes_of_entries, damaged, damages, few, many, outcome, with_changed_entries
from tests.training.test_targets import CONFIG, saved
from torchrl_h2o.data import DataError
from torchrl_h2o.objectives import make_actor
from torchrl_h2o.training.checkpoint import checkpoint_file, load_checkpoint, read_checkpoint, save_checkpoint
from torchrl_h2o.training.config_file import load_config
from torchrl_h2o.training.environments import make_reality
from torchrl_h2o.training.run_folder import claimed
from torchrl_h2o.training.trained_policy import load_policy

PROGRESS = {"epoch": 1, "seconds": 1.0, "update_seconds": 0.5, "rows": [{"method": "H2O+", "return_real": 2.0}]}


def parts(width=8):
    torch.manual_seed(0)
    actor = nn.Sequential(nn.Linear(3, width), nn.ReLU(), nn.Linear(width, 1))
    optimiser = torch.optim.Adam(actor.parameters())
    actor(torch.ones(3)).sum().backward()
    optimiser.step()
    return {"actor": actor, "optimiser": optimiser}


@pytest.fixture
def path(tmp_path):
    """A checkpoint as a run writes it."""
    path = checkpoint_file(tmp_path, "H2O+")
    save_checkpoint(path, parts(), PROGRESS)
    return path


def rewritten(path, change):
    """Writes the checkpoint again after a change of its contents."""
    contents = read_checkpoint(path)
    contents = change(contents) or contents
    torch.save(contents, path)
    return path


def refused(path, components=None):
    with pytest.raises(DataError) as caught:
        load_checkpoint(path, parts() if components is None else components)
    message = str(caught.value)
    assert "\n" not in message
    assert str(path) in message
    return message


def test_a_checkpoint_restores_what_was_saved(path):
    new = parts()
    with torch.no_grad():
        new["actor"][0].weight.zero_()
    assert load_checkpoint(path, new) == PROGRESS
    assert torch.equal(new["actor"][0].weight, parts()["actor"][0].weight)


def test_a_view_is_saved_without_the_tensor_that_it_looks_into(tmp_path):
    many = torch.zeros(1000, 1000)
    actor = nn.Linear(10, 1, bias=False)
    actor.weight.data = many[:1, :10]
    save_checkpoint(tmp_path / "one.pt", {"actor": actor}, PROGRESS)
    assert (tmp_path / "one.pt").stat().st_size < 10_000


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
def test_a_truncated_file_is_no_checkpoint(path, share):
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    assert "not a checkpoint that can be read" in refused(path)


def test_a_changed_byte_of_a_weight_is_found(path):
    weight = parts()["actor"][0].weight.detach().numpy().tobytes()
    contents = bytearray(path.read_bytes())
    contents[contents.index(weight)] ^= 1
    path.write_bytes(bytes(contents))
    assert "is damaged" in refused(path)


class Harmful:
    def __init__(self, evidence):
        self.evidence = str(evidence)

    def __reduce__(self):
        return os.mkdir, (self.evidence,)


def test_a_checkpoint_that_would_run_code_is_refused(path, tmp_path):
    evidence = tmp_path / "evidence"
    rewritten(path, lambda contents: contents | {"more": Harmful(evidence)})
    refused(path)
    assert not evidence.exists()
    torch.load(path, weights_only=False)  # the danger is real
    assert evidence.exists()


def test_a_checkpoint_that_is_compressed_is_refused_before_it_is_unpacked(path):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data/0", bytes(10**7))
    assert "is compressed" in refused(path)


def replace_actor(**changes):
    return lambda contents: contents["components"]["actor"].update({name.replace("_", ".", 1): value for name, value in
                                                                    changes.items()})  # fmt: skip


CHANGES = {
    "0.weight is torch.float32 [9, 3], not torch.float32 [8, 3]": replace_actor(**{"0_weight": torch.zeros(9, 3)}),
    "0.weight is torch.float64 [8, 3], not torch.float32 [8, 3]": replace_actor(
        **{"0_weight": torch.zeros(8, 3).double()}
    ),
    "0.weight has values that are NaN or infinite": replace_actor(**{"0_weight": torch.full((8, 3), float("nan"))}),
    "0.weight is 'text', not torch.float32": replace_actor(**{"0_weight": "text"}),
    "other is only in one of them": replace_actor(other=torch.zeros(1)),
    "is larger than its values": replace_actor(**{"0_weight": torch.zeros(1).expand(10**9, 10**9)}),
    "optimiser does not fit this run: it is missing": lambda contents: contents["components"].pop("optimiser") and None,
    "actor does not fit this run": lambda contents: contents["components"].update(actor={}),
    "exp_avg has the shape [2], not [8, 3]": lambda contents: contents["components"]["optimiser"]["state"][0].update(
        exp_avg=torch.zeros(2)
    ),
    "epoch is 'one'": lambda contents: contents["progress"].update(epoch="one"),
    "not a checkpoint that can be read": lambda contents: [contents],
    "can be read: 'progress'": lambda contents: contents.pop("progress") and None,
    "can be read: 'list' object has no attribute": lambda contents: contents["components"].update(actor=[]),
}


@pytest.mark.parametrize("said", CHANGES)
def test_contents_that_do_not_fit_are_one_line(path, said):
    assert said in refused(rewritten(path, CHANGES[said]))


def policy_folder(folder, **changes):
    """A run of a pendulum with a checkpoint of its policy, and a configuration that may claim something else."""
    saved(folder, {"num_cells": [16, 16]})
    cfg = load_config(folder)
    env = make_reality(cfg)
    actor = make_actor(4, env.action_spec_unbatched, cfg.num_cells)
    save_checkpoint(checkpoint_file(folder, "H2O+"), {"actor": actor}, PROGRESS)
    saved(folder, changes)
    return folder


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"num_cells": [10**9, 10**9]}, "num_cells=[1000000000,1000000000]: must be the sizes, up to 4096"),
        ({"num_cells": [16, 4096]}, "num_cells=[16, 4096] in config.yaml, but the policy's layers are [16, 16]"),
        ({"num_cells": [16, 16], "frames": 2}, "0.weight is torch.float32 [16, 4], not torch.float32 [16, 8]"),
        ({"num_cells": [16, 16], "frames": 10**9}, "frames=1000000000: must be an integer from 1 to 10000"),
        ({"num_cells": [16, 16], "action_history": 10**9}, "action_history=1000000000: must be an integer from 0"),
        ({"num_cells": [16, 16], "final_episodes": 10**9}, "final_episodes=1000000000: must be an integer from 1"),
    ],
)
def test_sizes_of_a_configuration_are_compared_with_the_checkpoint_s_before_networks_are_built(tmp_path, changes, said):
    folder = policy_folder(tmp_path / "run", **changes)
    with pytest.raises(DataError) as caught:
        load_policy(load_config(folder), folder)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_policy_that_fits_is_loaded(tmp_path):
    folder = policy_folder(tmp_path / "run", num_cells=[16, 16])
    assert next(load_policy(load_config(folder), folder).parameters()).shape == (16, 4)


def test_a_method_without_a_checkpoint_is_said_with_those_that_have_one(tmp_path):
    folder = policy_folder(tmp_path / "run", num_cells=[16, 16])
    with pytest.raises(FileNotFoundError, match=r"no checkpoint of 'IQL'; it has \['h2o\+'\]"):
        load_policy(load_config(folder), folder, "IQL")


@pytest.mark.parametrize("name", ["checkpoints", "run.lock", "metrics.csv", "config.yaml", "mended"])
@pytest.mark.parametrize("kind", ["link", "pipe"])
def test_a_folder_with_links_or_pipes_is_neither_read_nor_written_to(tmp_path, name, kind):
    folder, elsewhere = saved(tmp_path / "run", {}), tmp_path / "elsewhere"
    elsewhere.mkdir()
    (folder / name).unlink(missing_ok=True)
    (folder / name).symlink_to(elsewhere) if kind == "link" else os.mkfifo(folder / name)
    for action in (lambda: load_config(folder), lambda: claimed(folder).__enter__()):
        with pytest.raises(DataError, match=f"{name}: this is (a link|neither a file nor a folder)") as caught:
            action()
        assert "\n" not in str(caught.value)
    assert list(elsewhere.iterdir()) == []


def test_the_folder_of_a_run_may_itself_be_a_link(tmp_path):
    saved(tmp_path / "run", {})
    (tmp_path / "latest").symlink_to(tmp_path / "run")
    assert load_config(tmp_path / "latest").env.name == CONFIG["env"]["name"]


def read_or_refused(folder, content):
    path = Path(folder, "fuzzed.pt")
    path.write_bytes(content)
    components = parts()
    if outcome(lambda file: load_checkpoint(file, components), path) is not None:
        assert all(np.isfinite(parameter.detach().numpy()).all() for parameter in components["actor"].parameters())


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "whole.pt"
    save_checkpoint(path, parts(), PROGRESS)
    return path


@few
@given(changes=damages())
def test_a_damaged_checkpoint(whole, changes):
    read_or_refused(whole.parent, damaged(whole.read_bytes(), changes))


@pytest.mark.slow
@many
@given(changes=damages())
def test_many_damaged_checkpoints(whole, changes):
    read_or_refused(whole.parent, damaged(whole.read_bytes(), changes))


@pytest.mark.slow
@many
@given(member=st.integers(0, 20), changes=damages())
def test_many_checkpoints_with_damaged_members(whole, member, changes):
    """The archive stays whole, with right check sums, and one file in it is changed."""
    with zipfile.ZipFile(whole) as archive:
        held = {name: archive.read(name) for name in archive.namelist()}
    name = list(held)[member % len(held)]
    target = whole.parent / "members.pt"
    with zipfile.ZipFile(target, "w") as archive:
        for one, data in held.items():
            archive.writestr(one, damaged(data, changes) if one == name else data)
    read_or_refused(whole.parent, target.read_bytes())


@pytest.mark.slow
@many
@given(changes=changes_of_entries)
def test_many_checkpoints_with_changed_entries(whole, changes):
    target = whole.parent / "entries.pt"
    torch.save(with_changed_entries(dict(read_checkpoint(whole)), changes), target)
    read_or_refused(whole.parent, target.read_bytes())


@pytest.mark.slow
@many
@given(changes=changes_of_entries)
def test_many_configurations_beside_a_checkpoint(tmp_path_factory, changes):
    folder = tmp_path_factory.getbasetemp() / "configurations"
    if not folder.exists():
        policy_folder(folder, num_cells=[16, 16])
    entries = with_changed_entries(CONFIG | {"num_cells": [16, 16], "frames": 1, "action_history": 0}, changes)
    (folder / "config.yaml").write_text(yaml.safe_dump(entries), errors="surrogatepass")
    outcome(lambda one: load_policy(load_config(one), one), folder)
