"""A leg with three motors, whose joints may differ in friction and rotor inertia."""

from pathlib import Path

from motored_env import MotoredEnv

MODEL_PATH = Path(__file__).with_name("leg.xml")
JOINTS = ("abduction", "flexion", "knee")
CONTROL_STEP = 0.005  # s
FRAME_SKIP = 2


class LegEnv(MotoredEnv):
    """The leg; episodes start near the hanging pose."""

    def __init__(self) -> None:
        super().__init__(MODEL_PATH, FRAME_SKIP, CONTROL_STEP, start_angle=0.3)
