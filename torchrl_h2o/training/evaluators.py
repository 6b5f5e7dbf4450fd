"""Evaluates policies during a training: in the training's process, or in a second one beside the next updates."""

from __future__ import annotations

import multiprocessing
import pickle
import signal
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property, partial
from multiprocessing.connection import Connection

import torch
from omegaconf import DictConfig
from torchrl.envs import EnvBase

from torchrl_h2o.training.preprocessing import Preprocessing
from torchrl_h2o.training.returns import SEED, TRIAL_SEED, BestPolicy, Evaluation, evaluate
from torchrl_h2o.training.task import Task

Outcome = tuple[Evaluation, list[Evaluation]]  # in reality, and of each policy in the simulator
Evaluate = Callable[[Sequence[torch.nn.Module]], Outcome]

ENDS_WITHIN = 3.0  # s, after which a second process that still evaluates is ended


def evaluator_of(
    cfg: DictConfig, task: Task, preprocessing: Preprocessing, best: BestPolicy | None = None
) -> Evaluator:
    """Builds the evaluator of a run: in ``reality``, and with ``keep=best_in_simulator`` also in the simulator.

    With ``overlap=true`` it evaluates in a second process. The returns are the same, because an evaluation has its own
    random numbers.

    Args:
        cfg: the run's configuration.
        task: its task.
        preprocessing: preprocessing of the observations.
        best: stores the policy that is the best in the simulator; None with ``keep=last``.
    """
    make_trials = partial(task.make_training_simulator, cfg.trial_episodes, preprocessing)
    reality = Episodes(partial(task.make_reality, cfg.eval_episodes, preprocessing), cfg.eval_episodes, SEED)
    trials = None if best is None else Episodes(make_trials, cfg.trial_episodes, TRIAL_SEED)
    process = SecondProcess if cfg.overlap else ThisProcess
    return Evaluator(process(partial(evaluate_policies, reality, trials)), best)


class Evaluator:
    """Evaluates one policy at a time.

    Args:
        process: where it evaluates.
        best: stores the policy that is the best in the simulator; None evaluates in ``reality`` alone.
    """

    def __init__(self, process: ThisProcess | SecondProcess, best: BestPolicy | None) -> None:
        self._process, self._best = process, best

    @property
    def is_done(self) -> bool:
        """Whether :meth:`result` returns without waiting."""
        return self._process.is_done

    def start(self, policy: torch.nn.Module) -> None:
        """Begins to evaluate a policy with its present parameters."""
        self._process.start([policy] if self._best is None else self._best.to_evaluate(policy))

    def result(self) -> dict[str, float]:
        """Waits for the evaluation, and stores the policy if it is the best in the simulator so far.

        Returns:
            Metrics by column of metrics.csv.
        """
        in_reality, in_simulator = self._process.result()
        return {**in_reality.metrics(), **({} if self._best is None else self._best.consider(in_simulator))}

    def close(self) -> None:
        """Ends the evaluator's process, if it has one."""
        self._process.close()


class Episodes:
    """The episodes of an evaluation. Their environment is built when it is first needed.

    Args:
        make_env: builds the environment.
        episodes: number of episodes.
        seed: seed of the first one.
    """

    def __init__(self, make_env: Callable[[], EnvBase], episodes: int, seed: int) -> None:
        self._make_env, self._episodes, self._seed = make_env, episodes, seed

    @cached_property
    def _env(self) -> EnvBase:
        return self._make_env()

    def run(self, policy: torch.nn.Module) -> Evaluation:
        """Runs all of them with a policy."""
        return evaluate(self._env, policy, self._episodes, self._seed)


def evaluate_policies(reality: Episodes, trials: Episodes | None, policies: Sequence[torch.nn.Module]) -> Outcome:
    """Evaluates the last policy in ``reality``, and each one in the simulator if there are trials."""
    tried = [] if trials is None else [trials.run(policy) for policy in policies]
    return reality.run(policies[-1]), tried


class ThisProcess:
    """Evaluates in this process, as soon as it gets policies.

    Args:
        evaluation: evaluates policies, such as :func:`evaluate_policies` with its episodes.
    """

    is_done = True

    def __init__(self, evaluation: Evaluate) -> None:
        self._evaluation = evaluation

    def start(self, policies: Sequence[torch.nn.Module]) -> None:
        """Begins to evaluate policies."""
        self._result = self._evaluation(policies)

    def result(self) -> Outcome:
        """The evaluations of the last policies; waits for them."""
        return self._result

    def close(self) -> None:
        """Ends the process, if it is a second one."""


class SecondProcess:
    """The same in a second process, to which it sends policies through a pipe.

    The second process ends when the pipe closes, also if this process is killed.
    """

    def __init__(self, evaluation: Evaluate) -> None:
        context = multiprocessing.get_context("spawn")  # a forked process would share locks of torch's threads
        self._pipe, theirs = context.Pipe()
        arguments = (theirs, evaluation, torch.get_num_threads())
        self._process = context.Process(target=_evaluate_what_comes, args=arguments, daemon=True)
        self._process.start()
        theirs.close()

    @property
    def is_done(self) -> bool:
        """Whether :meth:`result` returns without waiting."""
        return self._pipe.poll()

    def start(self, policies: Sequence[torch.nn.Module]) -> None:
        with _other_end():
            self._pipe.send_bytes(pickle.dumps(policies))

    def result(self) -> Outcome:
        with _other_end():
            outcome = self._pipe.recv()
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    def close(self) -> None:
        self._pipe.close()
        self._process.join(ENDS_WITHIN)
        self._process.terminate()
        self._process.join()


@contextmanager
def _other_end() -> Iterator[None]:
    """Says what to do if the process at the other end of the pipe has ended."""
    try:
        yield
    except (EOFError, OSError):
        raise RuntimeError(
            "the second process, which evaluates, has ended: resume the run with overlap=false, which changes no result"
        ) from None


def _evaluate_what_comes(pipe: Connection, evaluation: Evaluate, threads: int) -> None:
    """Evaluates the policies that come through a pipe, until it is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to both processes; this one ends with the other
    torch.set_num_threads(threads)
    while True:
        try:
            policies = pickle.loads(pipe.recv_bytes())
        except (EOFError, OSError):  # OSError: the other end was closed before it had read the last result
            return
        try:
            outcome = evaluation(policies)
        except Exception as error:  # raised in the training's process
            outcome = _sendable(error)
        try:
            pipe.send(outcome)
        except OSError:
            return


def _sendable(error: Exception) -> Exception:
    """The error, or its text if it cannot be pickled, with the traceback as a note."""
    try:
        pickle.dumps(error)
    except Exception:
        error = RuntimeError(f"{type(error).__name__}: {error}").with_traceback(error.__traceback__)
    error.add_note("".join(traceback.format_tb(error.__traceback__)))
    return error
