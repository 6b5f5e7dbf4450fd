"""A pendulum with one motor, the smallest system of the benchmark."""

import math
from pathlib import Path

import mujoco
from motored_env import MotoredEnv

MODEL_PATH = Path(__file__).with_name("pendulum.xml")
CONTROL_STEP = 0.01  # s
FRAME_SKIP = 4


class PendulumEnv(MotoredEnv):
    """The pendulum; an angle of 0 hangs down, and episodes start at any angle."""

    def __init__(self) -> None:
        super().__init__(MODEL_PATH, FRAME_SKIP, CONTROL_STEP, start_angle=math.pi)

    @classmethod
    def critical_damping(cls) -> float:
        """Viscous friction at which small swings just do not overshoot, in N·m·s/rad: 2 √(m g l · m l²)."""
        model = mujoco.MjModel.from_xml_path(str(MODEL_PATH))
        mass, length = float(model.body("arm").mass[0]), -float(model.body("arm").ipos[2])
        weight = -float(model.opt.gravity[2]) * mass
        return 2.0 * math.sqrt(weight * length * mass * length**2)
