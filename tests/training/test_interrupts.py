"""Ctrl-C ends a training where the exception KeyboardInterrupt is replaced or lost."""

import signal
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict

from torchrl_h2o.comparison import recorded_run
from torchrl_h2o.training.interrupts import interruptible
from torchrl_h2o.training.progress import Budget, Training
from torchrl_h2o.training.run_folder import resumable


def ctrl_c():
    signal.raise_signal(signal.SIGINT)


def ctrl_c_within_parameters():
    network = torch.nn.Linear(1, 1)
    with TensorDict.from_module(network).to_module(network):
        ctrl_c()


def ctrl_c_in_a_finalizer():
    class Finalized:
        def __del__(self):
            ctrl_c()

    Finalized()


def ctrl_c_that_kills_the_compiler():
    try:
        ctrl_c()
    except KeyboardInterrupt:
        raise RuntimeError("g++ failed") from None


WAYS = [ctrl_c, ctrl_c_within_parameters, ctrl_c_that_kills_the_compiler, ctrl_c_in_a_finalizer]
unraisable = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")


@pytest.fixture
def handled_by():
    """Sets the handler of Ctrl-C for one test."""
    before = signal.getsignal(signal.SIGINT)
    yield lambda handler: signal.signal(signal.SIGINT, handler)
    signal.signal(signal.SIGINT, before)


@unraisable
@pytest.mark.parametrize("way", WAYS)
def test_ctrl_c_ends_the_block_as_keyboard_interrupt(way):
    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), interruptible():
        way()
    assert signal.getsignal(signal.SIGINT) is handler


@unraisable
@pytest.mark.parametrize("way", WAYS)
def test_after_ctrl_c_in_an_update_no_further_update_follows_and_the_run_says_how_it_goes_on(tmp_path, way):
    training = Training("H2O+", tmp_path / "checkpoint", Budget(updates=6, updates_per_epoch=3))
    updates = []
    with pytest.raises(SystemExit, match=r"interrupted; go on with: .* resume="), resumable(tmp_path):  # noqa: PT012
        for _ in training.epochs():
            for update in training.epoch_updates():
                updates.append(update)
                if update == 1:
                    way()
    assert updates == [0, 1]


@unraisable
@pytest.mark.parametrize("way", WAYS)
def test_after_ctrl_c_a_grid_does_not_go_on_with_its_next_run(tmp_path, monkeypatch, way):
    """Hydra's launchers treat any other exception as the failure of one run."""
    cfg = OmegaConf.create({"results": None})
    monkeypatch.setattr(recorded_run.HydraConfig, "get", lambda: OmegaConf.create({"overrides": {"task": []}}))
    monkeypatch.setattr(recorded_run, "check_options", lambda *args, **kwargs: None)
    monkeypatch.setattr(recorded_run, "open_run", lambda cfg, go_on: (cfg, tmp_path))
    monkeypatch.setattr(recorded_run, "train_and_record", lambda cfg, directory: way())
    with pytest.raises(KeyboardInterrupt):
        recorded_run.train_grid_run(cfg)


def test_an_error_without_ctrl_c_is_raised_as_it_is():
    with pytest.raises(OSError, match="the disk is full"), interruptible():
        raise OSError("the disk is full")


@pytest.mark.parametrize("handler", [signal.SIG_IGN, lambda number, frame: None])
def test_a_process_that_handles_ctrl_c_differently_goes_on(handled_by, handler):
    handled_by(handler)
    with interruptible():
        ctrl_c()
    assert signal.getsignal(signal.SIGINT) is handler


def test_a_block_in_another_thread_runs_as_it_is():
    def run():
        with interruptible():
            return "done"

    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(run).result() == "done"
