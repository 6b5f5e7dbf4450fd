"""Evaluates policies during a training: in the training's process, or in a second one beside the next updates."""

from __future__ import annotations

import multiprocessing
import pickle
import signal
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from multiprocessing.connection import Connection

import torch
from omegaconf import DictConfig
from torchrl.envs import EnvBase

from torchrl_h2o.training.preprocessing import Preprocessing
from torchrl_h2o.training.returns import Evaluation, evaluate
from torchrl_h2o.training.task import Task

ENDS_WITHIN = 3.0  # s, after which a second process that still evaluates is ended


def evaluator_of(cfg: DictConfig, task: Task, preprocessing: Preprocessing) -> Evaluator:
    """Builds the evaluator of a run, in ``reality``.

    With ``overlap=true`` it evaluates in a second process. The returns are the same, because an evaluation has its own
    random numbers.

    Args:
        cfg: the run's configuration.
        task: its task.
        preprocessing: preprocessing of the observations.
    """
    make_env = partial(task.make_reality, cfg.eval_episodes, preprocessing)
    return (SecondProcess if cfg.overlap else ThisProcess)(make_env, cfg.eval_episodes)


class ThisProcess:
    """Evaluates one policy at a time: in this process, as soon as it gets one.

    Args:
        make_env: builds ``reality``.
        episodes: number of episodes of an evaluation.
    """

    is_done = True

    def __init__(self, make_env: Callable[[], EnvBase], episodes: int) -> None:
        self._env, self._episodes = make_env(), episodes

    def start(self, policy: torch.nn.Module) -> None:
        """Begins to evaluate a policy with its present parameters."""
        self._result = evaluate(self._env, policy, self._episodes)

    def result(self) -> Evaluation:
        """The evaluation of the last policy; waits for it."""
        return self._result

    def close(self) -> None:
        """Ends the evaluator's process, if it has one."""


class SecondProcess:
    """The same in a second process, to which it sends policies through a pipe.

    The second process ends when the pipe closes, also if this process is killed.
    """

    def __init__(self, make_env: Callable[[], EnvBase], episodes: int) -> None:
        context = multiprocessing.get_context("spawn")  # a forked process would share locks of torch's threads
        self._pipe, theirs = context.Pipe()
        arguments = (theirs, make_env, episodes, torch.get_num_threads())
        self._process = context.Process(target=_evaluate_what_comes, args=arguments, daemon=True)
        self._process.start()
        theirs.close()

    @property
    def is_done(self) -> bool:
        """Whether :meth:`result` returns without waiting."""
        return self._pipe.poll()

    def start(self, policy: torch.nn.Module) -> None:
        with _other_end():
            self._pipe.send_bytes(pickle.dumps(policy))

    def result(self) -> Evaluation:
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


Evaluator = ThisProcess | SecondProcess


@contextmanager
def _other_end() -> Iterator[None]:
    """Says what to do if the process at the other end of the pipe has ended."""
    try:
        yield
    except (EOFError, OSError):
        raise RuntimeError(
            "the second process, which evaluates, has ended: resume the run with overlap=false, which changes no result"
        ) from None


def _evaluate_what_comes(pipe: Connection, make_env: Callable[[], EnvBase], episodes: int, threads: int) -> None:
    """Evaluates the policies that come through a pipe, until it is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to both processes; this one ends with the other
    torch.set_num_threads(threads)
    env = make_env()
    while True:
        try:
            policy = pickle.loads(pipe.recv_bytes())
        except (EOFError, OSError):  # OSError: the other end was closed before it had read the last result
            return
        try:
            outcome = evaluate(env, policy, episodes)
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
