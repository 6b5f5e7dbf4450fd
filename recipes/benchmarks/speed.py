"""Simulation speed: in tracing, and of the library compared with ``mujoco.rollout`` on the same states."""

import dataclasses
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from os import cpu_count

import mujoco
import numpy as np
from mujoco.rollout import Rollout

from torchrl_h2o.residuals import Simulation

BATCH, HORIZON = 4096, 20


@dataclass
class Count:
    """Number of simulated control steps, and the seconds in which at least one thread simulated."""

    steps: int = 0
    seconds: float = 0.0
    _inside: int = 0  # threads that simulate now
    _since: float = 0.0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @contextmanager
    def simulating(self, steps: int) -> Iterator[None]:
        """Count a number of steps that one thread simulates."""
        with self._lock:
            if not self._inside:
                self._since = time.perf_counter()
            self._inside += 1
        try:
            yield
        finally:
            with self._lock:
                self._inside -= 1
                self.steps += steps
                if not self._inside:
                    self.seconds += time.perf_counter() - self._since


@dataclass(frozen=True, eq=False)
class CountingSimulation(Simulation):
    """A simulation that counts its control steps and those of simulations derived from it."""

    count: Count = field(default_factory=Count)

    @classmethod
    def of(cls, simulation: Simulation) -> "CountingSimulation":
        """Wrap a simulation, counting from zero."""
        return cls(**{part.name: getattr(simulation, part.name) for part in dataclasses.fields(simulation)})

    def rollout(self, states: np.ndarray, actions: np.ndarray, **options: np.ndarray) -> np.ndarray:
        return self._counted(super().rollout, states, actions, **options)

    def follow(
        self, states: np.ndarray, actions: np.ndarray, time: np.ndarray, activations: np.ndarray | None = None
    ) -> np.ndarray:
        return self._counted(super().follow, states, actions, time, activations)

    def _counted(
        self, simulate: Callable[..., np.ndarray], states: np.ndarray, actions: np.ndarray, *args, **options
    ) -> np.ndarray:
        with self.count.simulating(actions.shape[0] * actions.shape[1]):
            return simulate(states, actions, *args, **options)


def steps_per_second(simulation: Simulation, seed: int = 0) -> dict[str, float]:
    """Control steps a second of the library and of ``mujoco.rollout``, the better of two measurements each."""
    model = simulation.model
    rng = np.random.default_rng(seed)
    states = simulation.state_map.offset + 0.01 * rng.standard_normal((BATCH, model.nq + model.nv))
    actions = rng.uniform(-1.0, 1.0, (BATCH, HORIZON, model.nu))

    full = np.zeros((BATCH, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    full[:, 1 : 1 + states.shape[1]] = states
    control = np.repeat(actions, simulation.frame_skip, axis=1)
    threads = [mujoco.MjData(model) for _ in range(cpu_count())]
    with Rollout(nthread=len(threads)) as bare:
        return {
            "library": _rate(lambda: simulation.rollout(states, actions)),
            "mujoco.rollout": _rate(lambda: bare.rollout(model, threads, full, control)),
        }


def _rate(simulate: Callable[[], object]) -> float:
    seconds = []
    for _ in range(2):
        start = time.perf_counter()
        simulate()
        seconds.append(time.perf_counter() - start)
    return BATCH * HORIZON / min(seconds)
