"""Trains H2O+ from images: the policy, Q, V and the discriminators share one convolutional encoder.

python recipes/pixels.py         # two minutes; the task paints its own images, so no GL library is needed
python recipes/pixels.py 4000    # more updates

The task is a puck on a table; the simulator's puck is too light and glides without friction. For a task of MuJoCo take
`GymEnv(..., from_pixels=True)` (with MUJOCO_GL=egl where there is no display) and stack frames with `CatFrames`.
"""

import torchrl_h2o.quiet  # noqa: F401, I001  (must precede the packages that it silences)

import sys

import gymnasium
import numpy as np
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal
from torchrl.objectives import SoftUpdate
from tqdm import tqdm

from torchrl_h2o import objectives
from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.envs import record

UPDATES = int(sys.argv[1]) if len(sys.argv) > 1 else 1000  # one simulated step each
FEATURES, STEPS = 32, 50  # numbers that the encoder makes of an image; steps of an episode
GRID = np.linspace(-1.0, 1.0, 16)  # places of an image's rows and columns, m


class Puck(gymnasium.Env):
    """Push a puck to the middle of a table by a force of at most 1 N. An observation shows the last two images."""

    observation_space = gymnasium.spaces.Box(0.0, 1.0, (2, len(GRID), len(GRID)), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)  # N

    def __init__(self, mass: float, friction: float) -> None:
        self.mass, self.friction = mass, friction  # kg, N·s/m

    def image(self) -> np.ndarray:
        return np.outer(*(np.exp(-(((GRID - place) / 0.2) ** 2)) for place in self.place)).astype(np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.count, self.place, self.velocity = 0, self.np_random.uniform(-0.8, 0.8, 2), np.zeros(2)
        self.images = np.stack([self.image()] * 2)
        return self.images, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.velocity = self.velocity + 0.1 * (action - self.friction * self.velocity) / self.mass
        self.place = np.clip(self.place + 0.1 * self.velocity, -1.0, 1.0)
        self.count, self.images = self.count + 1, np.stack([self.images[1], self.image()])
        return self.images, 1.0 - min(1.0, float(np.square(self.place).sum())), False, self.count == STEPS, {}


def pushes(step):
    return step.set("action", 2.0 * torch.rand(2) - 1.0)


torch.manual_seed(0)
reality, simulator = GymWrapper(Puck(mass=1.0, friction=0.5)), GymWrapper(Puck(mass=0.6, friction=0.0))
real = record(reality, pushes, 3000, seed=0, progress=False)
replay = HybridReplayBuffer(real, sim_capacity=20_000, batch_size=(32, 32))

# All heads share the encoder's parameters, and every loss trains them; separate_losses=True leaves them to the policy
convolutions = nn.Sequential(nn.Conv2d(2, 8, 4, 2), nn.ReLU(), nn.Conv2d(8, 8, 3, 2), nn.ReLU(), nn.Flatten(-3))
encoder = nn.Sequential(convolutions, nn.Linear(8 * 9, FEATURES), nn.LayerNorm(FEATURES), nn.Tanh())
now = TensorDictModule(encoder, ["observation"], ["z"])
after = TensorDictModule(encoder, [("next", "observation")], [("next", "z")])


def head(outputs, *keys, out, encoders=(now,)):
    network = MLP(sum(2 if key == "action" else FEATURES for key in keys), outputs, num_cells=[64])
    return TensorDictSequential(*encoders, TensorDictModule(network, list(keys), [out]))


split = TensorDictModule(NormalParamExtractor(), ["parameters"], ["loc", "scale"])
policy = TensorDictSequential(head(4, "z", out="parameters"), split)
actor = ProbabilisticActor(policy, ["loc", "scale"], spec=simulator.action_spec, distribution_class=TanhNormal)
qvalues, value = [head(1, "z", "action", out="state_action_value") for _ in range(2)], head(1, "z", out="state_value")
sa, sas = head(2, "z", "action", out="sa"), head(2, "z", "action", ("next", "z"), out="sas", encoders=(now, after))
ratio_loss = objectives.DynamicsRatioLoss(objectives.DynamicsRatioEstimator(sa, sas), input_noise=0.02)
bellman_loss = objectives.MixedBellmanLoss(actor, qvalues, value, alpha_init=0.05)
loss = objectives.H2OPlusLoss(bellman_loss, objectives.ExpectileValueLoss(value), ratio_loss)
optimiser, targets = torch.optim.Adam(loss.parameters(), lr=1e-3), SoftUpdate(loss, tau=0.02)
for steps in tqdm(Collector(simulator, actor, frames_per_batch=100, total_frames=UPDATES), unit="00 updates"):
    replay.extend(steps)
    for _ in range(100):
        optimiser.zero_grad()
        objectives.total_loss(loss(replay.sample())).backward()
        optimiser.step()
        targets.step()
with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
    returns = [reality.rollout(STEPS, actor)["next", "reward"].sum().item() for _ in range(10)]
of_data = float(real["next", "reward"].sum()) * STEPS / len(real)
print(f"\nreturn in reality, of at most {STEPS}\n  pixels   {sum(returns) / 10:6.1f}\n  data     {of_data:6.1f}")
