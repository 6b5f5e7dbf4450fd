"""A training whose losses or parameters are not finite stops, names the update, and keeps the last checkpoint."""

import json
import pickle
import subprocess

import pytest
import torch
from torch import nn

from tests.small_runs import ROBOT, SMALL
from torchrl_h2o.commands.one_line_errors import is_expected
from torchrl_h2o.comparison import recorded_run
from torchrl_h2o.training.checkpoint import checkpoint_file
from torchrl_h2o.training.divergence import DivergenceError, are_finite, not_finite_losses
from torchrl_h2o.training.progress import Budget, Training

NAN, INF = float("nan"), float("inf")


@pytest.fixture
def new_training(tmp_path):
    def build():
        network = nn.Linear(1, 1)
        optimiser = torch.optim.Adam(network.parameters(), lr=0.25)
        return network, Training("H2O+", tmp_path, Budget(2500, 1000), network=network, optimiser=optimiser)

    return build


def train(network, training, losses_at=lambda number: {"loss_a": 1.0}, weight_at=float):
    """Trains with these losses and weights by the number of the update; by default the weight is that number."""
    for epoch, _ in training.epochs():
        for update in training.epoch_updates():
            number = epoch * 1000 + update + 1
            training.check({name: torch.tensor(value) for name, value in losses_at(number).items()})
            with torch.no_grad():
                network.weight.fill_(weight_at(number))


def test_the_loss_the_update_and_the_remedy_are_named_and_the_last_checkpoint_is_kept(new_training):
    def losses_at(number):
        return {"loss_a": 1.0, "loss_b": NAN if number >= 1234 else 1.0, "alpha": INF}

    said = (
        r"^H2O\+: loss_b is nan at update 1,234 of 3,000 \(epoch 2\)\. The checkpoint of update 1,000 is kept; resume="
    )
    with pytest.raises(DivergenceError, match=said + r".*smaller lr \(now 0\.25\)") as raised:
        train(*new_training(), losses_at)
    assert "\n" not in str(raised.value)
    assert raised.value.failure == {
        "updates": 1233,
        "why": "H2O+: loss_b is nan at update 1,234 of 3,000 (epoch 2)",
    }
    assert is_expected(raised.value)
    network, training = new_training()
    assert network.weight.item() == 1000
    assert training.progress["epoch"] == 1
    train(network, training)
    assert new_training()[0].weight.item() == 3000


def test_a_resumed_training_names_the_checkpoint_that_it_came_from(new_training):
    for _ in range(2):
        with pytest.raises(DivergenceError, match=r"at update 2,001 of 3,000.*checkpoint of update 2,000 is kept"):
            train(*new_training(), lambda number: {"loss_a": INF if number > 2000 else 1.0})


def test_a_training_that_diverges_before_its_first_checkpoint_says_so(new_training, tmp_path):
    with pytest.raises(DivergenceError, match=r"update 1 of 3,000 .*There is no checkpoint yet"):
        train(*new_training(), lambda number: {"loss_a": -INF})
    assert not checkpoint_file(tmp_path, "H2O+").exists()


def test_a_parameter_that_is_not_finite_stops_the_training_before_the_checkpoint_is_written(new_training):
    said = r"a parameter is not finite at update 2,000 .*of update 1,000 is kept"
    with pytest.raises(DivergenceError, match=said):
        train(*new_training(), weight_at=lambda number: NAN if number > 1990 else 7.0)
    assert new_training()[0].weight.item() == 7.0


def test_losses_and_parameters_that_are_finite_pass():
    terms = {"loss_a": torch.tensor(1e30, requires_grad=True), "accuracy": torch.tensor(NAN)}
    assert not_finite_losses(terms) is None
    assert not_finite_losses(terms | {"loss_b": torch.tensor(INF)}) == "loss_b is inf"
    assert are_finite([nn.Linear(2, 2), nn.ReLU()])
    assert are_finite([])


def test_the_error_reaches_another_process():
    error = pickle.loads(pickle.dumps(DivergenceError("message", "why", 3)))
    assert (str(error), error.failure) == ("message", {"updates": 3, "why": "why"})


def test_a_grid_does_not_train_a_run_again_that_has_diverged(tmp_path, monkeypatch):
    monkeypatch.setattr(recorded_run, "run_job", lambda *args: pytest.fail("it was trained again"))
    (tmp_path / "summary.json").write_text(json.dumps({"return_real": None, "failure": "SAC: loss_a is nan"}))
    with pytest.raises(DivergenceError, match=r"SAC: loss_a is nan in an earlier attempt.*remove"):
        recorded_run.train_and_record(None, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(("script", "options"), [("h2o_plus.py", []), ("train.py", ["method=sac", "lr=1e12"])])
def test_a_run_that_diverges_ends_with_one_line_and_status_1(command, tmp_path, script, options):
    small = [*SMALL, *ROBOT, "updates_per_epoch=1", "hydra.run.dir=out", "lr=1e6", *options]
    done = subprocess.run(**command(*small, script=script), text=True, check=False)
    assert done.returncode == 1
    assert "Traceback" not in done.stdout
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("DivergenceError: ")]
    assert "is kept; resume=out would repeat" in line
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["failure"] in line
    assert summary["return_real"] is None
    replayed = subprocess.run(
        **command("checkpoint=out", "episodes=1", "film=null", *(["method=SAC in the simulator"] * bool(options)),
                  script="evaluate.py"), text=True, check=False,
    )  # fmt: skip
    assert replayed.returncode == 0, replayed.stdout
