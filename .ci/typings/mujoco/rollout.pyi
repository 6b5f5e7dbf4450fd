# The annotations of mujoco.rollout itself, with the arrays that it returns; its own source leaves them out.
from typing import Any

import numpy as np

class Rollout:
    nthread: int
    def __init__(self, *, nthread: int | None = None) -> None: ...
    def close(self) -> None: ...
    def rollout(
        self,
        model: Any,
        data: Any,
        initial_state: np.ndarray,
        control: np.ndarray | None = None,
        *,
        control_spec: int = ...,
        skip_checks: bool = False,
        nstep: int | None = None,
        initial_warmstart: np.ndarray | None = None,
        state: np.ndarray | None = None,
        sensordata: np.ndarray | None = None,
        chunk_size: int | None = None,
    ) -> tuple[np.ndarray, np.ndarray]: ...
