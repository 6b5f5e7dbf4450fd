"""The training loop of train.py: options reach the losses, and an interrupted training continues exactly."""

import signal

import pytest
import torch

from tests.small_runs import interrupt_at, trained
from torchrl_h2o.data import write_ted
from torchrl_h2o.training.checkpoint import checkpoint_file, read_checkpoint, save_checkpoint
from torchrl_h2o.training.environments import make_simulator
from torchrl_h2o.training.judging import best_trial
from torchrl_h2o.training.loop import train
from torchrl_h2o.training.methods.h2o_plus import H2O_PLUS
from torchrl_h2o.training.methods.sac import SAC
from torchrl_h2o.training.progress import Training
from torchrl_h2o.training.returns import TRIAL_SEED, BestPolicy, Evaluation, evaluate
from torchrl_h2o.training.trained_policy import load_policy


def test_recorded_data_can_be_named_by_their_folder(compose, tmp_path):
    cfg, real = compose()
    again, same = compose(f"data={write_ted(real, tmp_path / 'recording')}")
    assert (same == real).all()
    assert again.observation_norm == cfg.observation_norm


@pytest.mark.slow
def test_backbone_mixing_and_ratio_reach_the_losses(compose, tmp_path):
    chosen = [(), ("backbone=sparse",), ("backbone=exponential",), ("mixing=0.9",), ("ratio=false",), ("gamma=0.5",)]
    losses = []
    for number, overrides in enumerate(chosen):
        cfg, real = compose("updates=20", *overrides)
        _, training = train(H2O_PLUS, cfg, real, tmp_path / str(number))
        losses.append((training.rows[-1]["loss_qvalue"], training.rows[-1]["loss_value"]))
    assert len(set(losses)) == len(chosen)


@pytest.mark.slow
def test_the_policy_that_was_best_in_the_simulator_is_handed_over(compose, tmp_path, monkeypatch):
    cfg, real = compose("updates=100", "keep=best_in_simulator", "trial_episodes=2", "lr=0.01", "seed=7")
    policy, training = train(H2O_PLUS, cfg, real, tmp_path / "whole")
    promised = [row["return_trial"] for row in training.rows]
    assert max(promised) > promised[-1]
    for handed_over in (policy, load_policy(cfg, tmp_path / "whole")):
        assert evaluate(make_simulator(cfg, 2), handed_over, 2, TRIAL_SEED).lower_bound == max(promised)

    interrupted = interrupt_at(epoch=promised.index(max(promised)) + 1, evaluate=Training.evaluate)
    monkeypatch.setattr(Training, "evaluate", interrupted)
    with pytest.raises(KeyboardInterrupt):
        train(H2O_PLUS, cfg, real, tmp_path / "parts")
    monkeypatch.undo()
    train(H2O_PLUS, cfg, real, tmp_path / "parts")
    assert trained(tmp_path / "parts") == trained(tmp_path / "whole")


@pytest.mark.parametrize(("returns", "kept"), [((5.0, 3.0, 4.0), 0), ((5.0, 7.0, 6.0), 1), ((5.0, 4.0, 8.0), 2)])
def test_the_policy_is_never_worse_in_the_simulator_than_where_the_training_began(returns, kept):
    weights = range(len(returns))
    actor = torch.nn.Linear(1, 1, bias=False)
    actor.weight.data.fill_(0.0)
    best, considered = BestPolicy(actor), []
    for weight in weights[1:]:
        actor.weight.data.fill_(weight)
        tried = best.to_evaluate(actor)
        actor.weight.data.fill_(-1.0)  # the training goes on during the evaluation
        considered.append(best.consider([Evaluation([returns[int(policy.weight)]], [1]) for policy in tried]))
    assert [one["return_trial"] for one in considered] == list(returns[1:])
    assert best_trial(considered) == max(returns)
    assert best.policy.weight == kept


def test_a_policy_is_judged_by_the_lower_bound_of_its_return():
    steady, lucky = Evaluation([10.0, 10.0, 10.0, 10.0], [1] * 4), Evaluation([0.0, 20.0, 20.0, 4.0], [1] * 4)
    assert lucky.mean > steady.mean
    assert lucky.lower_bound < steady.lower_bound == 10.0


@pytest.mark.slow
def test_ctrl_c_waits_until_the_checkpoint_is_written(compose, tmp_path, monkeypatch):
    cfg, real = compose("updates=60")

    def interrupted(*args):
        signal.raise_signal(signal.SIGINT)
        save_checkpoint(*args)

    monkeypatch.setattr("torchrl_h2o.training.progress.save_checkpoint", interrupted)
    with pytest.raises(KeyboardInterrupt):
        train(SAC, cfg, real, tmp_path)
    assert read_checkpoint(checkpoint_file(tmp_path, SAC.title))["progress"]["epoch"] == 1
