"""Record the random draws of a forward pass, and replace them by given numbers.

``vmap`` uses one random stream for all members. To give each member its own stream, the draws of one forward pass are
recorded once (kind, shape, type). The numbers are then drawn for each member outside of ``vmap`` and played back in it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

_NORMAL = (torch.randn_like, torch.randn, torch.normal, torch.Tensor.normal_)
_UNIFORM = (torch.rand_like, torch.rand, torch.Tensor.uniform_)
_IN_PLACE = (torch.Tensor.normal_, torch.Tensor.uniform_)
_ADVICE = "Population supplies normal and uniform numbers only; train such members as single runs"


@dataclass(frozen=True)
class Draw:
    """One random draw of a forward pass.

    Args:
        kind: ``"normal"`` (mean 0, standard deviation 1) or ``"uniform"`` (0 to 1).
        shape: shape of one member's numbers.
        dtype: type of the numbers.
        device: device of the numbers.
    """

    kind: str
    shape: torch.Size
    dtype: torch.dtype
    device: torch.device

    def make(self, generator: torch.Generator | None = None, *, members: Sequence[int] = ()) -> Tensor:
        """Draw the numbers, ``[*members, *shape]``, from a generator; torch's global generator by default."""
        numbers = torch.empty((*members, *self.shape), dtype=self.dtype, device=self.device)
        return numbers.normal_(generator=generator) if self.kind == "normal" else numbers.uniform_(generator=generator)


@dataclass
class Tape:
    """Numbers to be played back, in the order of the draws in the forward pass."""

    numbers: Sequence[Tensor] = ()
    position: int = field(default=0)

    def next(self) -> Tensor:
        """Return the next draw's numbers.

        Raises:
            RuntimeError: if the forward pass makes more draws than when it was recorded.
        """
        if self.position >= len(self.numbers):
            raise RuntimeError("a member's forward draws more random numbers than when it was recorded: " + _ADVICE)
        self.position += 1
        return self.numbers[self.position - 1]


class Playback(TorchFunctionMode):
    """Replaces the draws of a forward pass by the numbers of a tape.

    Create the instance before compilation and keep it, because a compiled forward pass cannot create one.
    """

    def __init__(self, tape: Tape) -> None:
        super().__init__()
        self.tape = tape

    def __torch_function__(self, func: Callable, types: tuple, args: tuple = (), kwargs: dict | None = None):
        kwargs = {} if kwargs is None else kwargs
        if func in _NORMAL:
            return _scaled_normal(func, self.tape.next(), args, kwargs)
        if func in _UNIFORM:
            return _scaled_uniform(func, self.tape.next(), args, kwargs)
        return func(*args, **kwargs)


class Recording(TorchFunctionMode):
    """Records the draws of a forward pass in ``draws``.

    Raises:
        NotImplementedError: for random functions that cannot be played back, such as dropout, and for a tensor that
            is filled with random numbers in place and then read through another reference.
    """

    def __init__(self, devices: Sequence[torch.device]) -> None:
        super().__init__()
        self.draws: list[Draw] = []
        self._devices = [device for device in devices if device.type == "cuda"]
        self._filled: list[Tensor] = []

    def _state(self) -> list[Tensor]:
        return [torch.get_rng_state(), *(torch.cuda.get_rng_state(device) for device in self._devices)]

    def __torch_function__(self, func: Callable, types: tuple, args: tuple = (), kwargs: dict | None = None):
        kwargs = {} if kwargs is None else kwargs
        if any(argument is filled for argument in (*args, *kwargs.values()) for filled in self._filled):
            raise NotImplementedError(
                f"a tensor is filled with random numbers in place and read afterwards. {_ADVICE}."
            )
        before = self._state()
        result = func(*args, **kwargs)
        if func in _NORMAL + _UNIFORM:
            _refuse_own_generator(kwargs)
            self.draws.append(
                Draw("normal" if func in _NORMAL else "uniform", result.shape, result.dtype, result.device)
            )
            if func in _IN_PLACE:
                self._filled.append(result)
                return result.clone()
        elif any((one != other).any() for one, other in zip(before, self._state(), strict=True)):
            raise NotImplementedError(f"a member's forward draws random numbers with {func.__name__}. {_ADVICE}.")
        return result


def record(forward: Callable[[], object], devices: Sequence[torch.device] = ()) -> list[Draw]:
    """Run a forward pass once without gradients and return its draws; torch's random state is restored.

    Args:
        forward: function without arguments.
        devices: devices whose random states are watched and restored, in addition to the CPU's.
    """
    recording = Recording(devices)
    indices = [device for device in devices if device.type == "cuda"]
    with torch.random.fork_rng(indices), torch.no_grad(), recording:
        forward()
    return recording.draws


def _refuse_own_generator(kwargs: dict) -> None:
    if kwargs.get("generator") is not None:
        raise NotImplementedError(f"a member's forward draws from a generator of its own. {_ADVICE}.")


def _scaled_normal(func: Callable, numbers: Tensor, args: tuple, kwargs: dict) -> Tensor:
    """Scale standard normal numbers to the mean and standard deviation in the arguments of the call."""
    if func is torch.Tensor.normal_:
        args = args[1:]
    elif func is not torch.normal:
        return numbers
    mean = args[0] if args else kwargs.get("mean", 0.0)
    std = args[1] if len(args) > 1 else kwargs.get("std", 1.0)
    if not args and not kwargs:
        return numbers
    return numbers * std + mean


def _scaled_uniform(func: Callable, numbers: Tensor, args: tuple, kwargs: dict) -> Tensor:
    """Scale uniform numbers to the bounds in the arguments of the call."""
    if func is not torch.Tensor.uniform_:
        return numbers
    low = args[1] if len(args) > 1 else kwargs.get("from", 0.0)
    high = args[2] if len(args) > 2 else kwargs.get("to", 1.0)
    return low + (high - low) * numbers
