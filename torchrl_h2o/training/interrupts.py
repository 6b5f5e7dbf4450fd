"""Handles Ctrl-C in code that cannot stop at any line, or that loses the exception KeyboardInterrupt."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Delays Ctrl-C to the end of the block, because inside file operations it could appear as an OSError."""
    if threading.current_thread() is not threading.main_thread():  # only the main thread receives signals
        yield
        return
    came = []
    before = signal.signal(signal.SIGINT, lambda number, frame: came.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if came:
            signal.raise_signal(signal.SIGINT)


@contextmanager
def interruptible() -> Iterator[None]:
    """Ends the block with KeyboardInterrupt after Ctrl-C, even if code in the block replaces or loses that exception.

    Ctrl-C still interrupts the block at once, but three things may happen to its exception. ``TensorDict.to_module``,
    used as a context, replaces it by a RuntimeError (tensordict 0.14). ``torch.compile`` raises an error of its own if
    Ctrl-C has also killed the C++ compiler. Python drops it in a finalizer; then :func:`raise_lost_interrupt` ends the
    block, or its end is reached.

    The block runs as it is outside the main thread, and where the process ignores Ctrl-C or handles it without
    KeyboardInterrupt.

    Raises:
        KeyboardInterrupt: if Ctrl-C came. Its cause is the other exception that left the block.

    Example:
        >>> try:
        ...     with interruptible():
        ...         try:
        ...             signal.raise_signal(signal.SIGINT)  # Ctrl-C
        ...         except KeyboardInterrupt:
        ...             raise RuntimeError("the compiler failed")
        ... except KeyboardInterrupt as interrupt:
        ...     print(repr(interrupt.__cause__))
        RuntimeError('the compiler failed')
    """
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield
        return
    handler = _Remembering(before)
    signal.signal(signal.SIGINT, handler)
    try:
        yield
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        if handler.came:
            raise KeyboardInterrupt from error
        raise
    finally:
        signal.signal(signal.SIGINT, before)
    if handler.came:
        raise KeyboardInterrupt


def raise_lost_interrupt() -> None:
    """Raises KeyboardInterrupt in a block of :func:`interruptible` in which Ctrl-C came before; for long loops."""
    handler = signal.getsignal(signal.SIGINT)
    if isinstance(handler, _Remembering) and handler.came:
        raise KeyboardInterrupt


class _Remembering:
    """A handler of Ctrl-C that calls an earlier one, and notes whether that raised KeyboardInterrupt."""

    def __init__(self, before: Callable[[int, FrameType | None], Any]) -> None:
        self._before, self.came = before, False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        try:
            self._before(number, frame)
        except KeyboardInterrupt:
            self.came = True
            raise
