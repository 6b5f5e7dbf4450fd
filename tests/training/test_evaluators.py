"""Evaluation in a second process, beside the updates: the same returns, and no checkpoint without an earlier row."""

import multiprocessing
import signal
from dataclasses import dataclass, field

import pytest
import torch
from tensordict.nn import TensorDictModule

from tests.small_runs import rows, trained
from torchrl_h2o.objectives import make_actor
from torchrl_h2o.training.checkpoint import read_checkpoint
from torchrl_h2o.training.environments import preprocessing_of, task_of
from torchrl_h2o.training.evaluators import evaluator_of
from torchrl_h2o.training.loop import train
from torchrl_h2o.training.methods import METHODS
from torchrl_h2o.training.progress import Budget, Training
from torchrl_h2o.training.returns import BestPolicy


@pytest.fixture
def evaluators(compose):
    """Evaluators of the same run in this process and in a second one, the best policies of both, and a policy."""
    torch.manual_seed(0)
    cfg, _ = compose()
    actor = make_actor(4, task_of(cfg).make_reality().action_spec_unbatched, [8, 8])
    chosen, best = [], []
    for overlap in ("false", "true"):
        cfg, _ = compose(f"overlap={overlap}", "keep=best_in_simulator")
        best.append(BestPolicy(actor))
        chosen.append(evaluator_of(cfg, task_of(cfg), preprocessing_of(cfg), best[-1]))
    yield *chosen, best, actor
    for evaluator in chosen:
        evaluator.close()


def refuse(observation):
    raise ValueError(f"no action for {len(observation)} values")


def refuse_with_a_lambda(observation):
    error = ValueError("no action")
    error.why = lambda: "a function, which pickle refuses"
    raise error


@pytest.mark.slow
def test_a_second_process_gives_the_returns_and_the_errors_of_this_one(evaluators):
    """One test, because starting a process takes as long as all of it."""
    here, beside, best, actor = evaluators
    for _ in range(3):  # the policy as it is at the start
        here.start(actor)
        beside.start(actor)
        for parameter in actor.parameters():
            parameter.data.mul_(1.5)
        found = here.result()
        assert beside.result() == found
        assert found["return_kept"] >= found["return_trial"]
    torch.testing.assert_close(best[0].policy.state_dict(), best[1].policy.state_dict())

    beside.start(TensorDictModule(refuse, in_keys=["observation"], out_keys=["action"]))
    with pytest.raises(ValueError, match="no action for"):
        beside.result()
    beside.start(TensorDictModule(refuse_with_a_lambda, in_keys=["observation"], out_keys=["action"]))
    with pytest.raises(RuntimeError, match="ValueError: no action") as caught:  # an error that cannot be sent
        beside.result()
    assert "in refuse_with_a_lambda" in caught.value.__notes__[0]

    beside.start(actor)
    (process,) = multiprocessing.active_children()
    process.kill()
    with pytest.raises(RuntimeError, match="overlap=false"):
        beside.result()


@pytest.mark.slow
def test_a_second_process_whose_result_nobody_reads_ends_without_an_error(evaluators, capfd):
    _, beside, _, actor = evaluators
    (process,) = multiprocessing.active_children()
    beside.start(actor)
    while not beside.is_done:
        process.join(0.01)
    beside.close()
    assert process.exitcode in (0, -signal.SIGTERM)
    assert "Traceback" not in capfd.readouterr().err


@dataclass
class Waiting:
    """An evaluator that has its result when a test says so, and gives the policy's weight as the return."""

    is_done: bool = False
    weights: list = field(default_factory=list)

    def start(self, policy):
        self.weights.append(policy.weight.item())

    def result(self):
        return {"return_real": self.weights[-1]}


def advance(folder, evaluator, done_before=None, stop_before=None):
    """Trains a network whose weight is the number of the epoch, with an evaluation after each third epoch."""
    actor = torch.nn.Linear(1, 1, bias=False)
    training = Training("H2O+", folder, Budget(6, 1, eval_every=3), actor=actor)
    saved = []
    for epoch, evaluating in training.epochs():
        there = training.checkpoint.exists()
        saved.append(read_checkpoint(training.checkpoint)["progress"]["epoch"] if there else 0)
        if epoch == stop_before:
            break
        evaluator.is_done = epoch == done_before
        actor.weight.data.fill_(epoch + 1)
        if evaluating:
            training.evaluate(evaluator, actor, epoch)
    return training.progress["rows"], saved


def test_checkpoints_are_put_off_while_an_evaluation_runs_but_not_beyond_the_next_one(tmp_path):
    found, saved = advance(tmp_path, Waiting())
    assert [row["return_real"] for row in found] == [3.0, 6.0]
    assert saved == [0, 1, 2, 2, 2, 5]
    _, saved = advance(tmp_path / "sooner", Waiting(), done_before=3)
    assert saved == [0, 1, 2, 2, 4, 5]


def test_a_run_stopped_beside_an_evaluation_repeats_it(tmp_path):
    unbroken, _ = advance(tmp_path / "unbroken", Waiting())
    advance(tmp_path / "broken", Waiting(), stop_before=3)
    again, saved = advance(tmp_path / "broken", Waiting())
    assert saved[0] == 2
    assert again == unbroken


@pytest.mark.slow
def test_a_training_beside_evaluations_is_the_training_without(compose, tmp_path):
    for overlap in ("false", "true"):
        cfg, real = compose("updates=60", "eval_every=1", f"overlap={overlap}", "keep=best_in_simulator")
        train(METHODS["h2o_plus"], cfg, real, tmp_path / overlap)
    assert rows(tmp_path / "true") == rows(tmp_path / "false")
    assert trained(tmp_path / "true") == trained(tmp_path / "false")
