"""Tutorial: H2O+ on your own environment. Takes one to two minutes.

python recipes/tutorials/h2o_plus_on_your_env.py

H2O+ needs transitions measured on the real system, and a simulator of that system. In this tutorial both are models of
a cart on a rail; the simulator has a wrong mass and no friction.
"""

# %% Your environment. Any environment with a continuous, bounded action works: one of Gymnasium as here, of dm_control,
# or TorchRL's own. Only the keys `observation`, `action` and `reward` matter.
import torchrl_h2o.quiet  # noqa: F401, I001  (must precede the packages that it silences)

import sys

import gymnasium
import numpy as np
import torch
from torchrl.collectors import Collector
from torchrl.envs import DoubleToFloat, GymWrapper, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SoftUpdate
from tqdm import tqdm

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.envs import record
from torchrl_h2o.objectives import (
    DynamicsRatioLoss,
    ExpectileValueLoss,
    H2OPlusLoss,
    MixedBellmanLoss,
    make_actor,
    make_dynamics_ratio_estimator,
    make_qvalue,
    make_value,
)

UPDATES = int(sys.argv[1]) if len(sys.argv) > 1 else 2000


class Cart(gymnasium.Env):
    """Move a cart to the middle of its rail by a force of at most 2 N. A step takes 0.05 s, an episode 10 s."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)  # position (m), velocity (m/s)
    action_space = gymnasium.spaces.Box(-2.0, 2.0, (1,), np.float32)  # force (N)

    def __init__(self, mass: float, friction: float) -> None:
        self.mass, self.friction = mass, friction  # kg, N·s/m

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.steps, self.state = 0, self.np_random.uniform(-1.0, 1.0, 2)
        return self.state.astype(np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        position, velocity = self.state
        velocity += 0.05 * (float(action[0]) - self.friction * velocity) / self.mass
        position += 0.05 * velocity
        self.steps, self.state = self.steps + 1, np.array([position, velocity])
        reward = 1.0 - min(1.0, position**2 + 0.1 * velocity**2)
        return self.state.astype(np.float32), reward, False, self.steps == 200, {}


reality = TransformedEnv(GymWrapper(Cart(mass=2.0, friction=0.5)), DoubleToFloat())
simulator = TransformedEnv(GymWrapper(Cart(mass=1.0, friction=0.0)), DoubleToFloat())

# %% The real data. Usually they come from a file: `torchrl_h2o.data.load("log.csv", columns="log.yaml")`. Here a noisy
# operator drives the cart for 150 s. The operator need not be good, but the data should cover different states.
torch.manual_seed(0)


def operator(step):
    position, velocity = step["observation"].unbind(-1)
    return step.set("action", (-0.5 * position - 0.3 * velocity + torch.randn(())).clamp(-2.0, 2.0)[..., None])


real = record(reality, operator, 3000, seed=0, progress=False)
print(f"the operator's return in reality: {real['next', 'reward'].sum() / 15:.0f} of 200")

# %% Networks and losses. V is trained on real rows only. Q is trained on both, with simulated rows weighted by the
# dynamics ratio. The policy maximises Q.
actor, value = make_actor(2, simulator.action_spec, (64, 64)), make_value(2, (64, 64))
loss = H2OPlusLoss(
    MixedBellmanLoss(actor, [make_qvalue(2, 1, (64, 64)) for _ in range(2)], value, mixing=0.1),
    value_loss=ExpectileValueLoss(value, 0.7),
    ratio_loss=DynamicsRatioLoss(make_dynamics_ratio_estimator(2, 1, (64, 64))),
)
optimiser = torch.optim.Adam(loss.parameters(), lr=2e-3)
targets = SoftUpdate(loss, tau=0.02)

# %% Training. The collector steps the policy in the simulator; the replay buffer draws as many real rows as simulated
# ones, and marks the real ones in the entry `real`.
replay = HybridReplayBuffer(real, sim_capacity=20_000, batch_size=(64, 64))
for steps in tqdm(Collector(simulator, actor, frames_per_batch=200, total_frames=UPDATES), unit=" epochs"):
    replay.extend(steps)
    for _ in range(200):
        losses = loss(replay.sample())
        optimiser.zero_grad()
        sum(term for name, term in losses.items() if name.startswith("loss_")).backward()
        optimiser.step()
        targets.step()

# %% The result in reality. `dynamics_ratio` is the mean weight of the simulated rows: near 1 if they are likely in
# reality, near 0 if they are not.
with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
    returns = [reality.rollout(200, actor)["next", "reward"].sum().item() for _ in range(5)]
print(f"the policy's return in reality:   {sum(returns) / 5:.0f} of 200")
print(f"mean weight of simulated rows:    {losses['dynamics_ratio']:.2f}")
