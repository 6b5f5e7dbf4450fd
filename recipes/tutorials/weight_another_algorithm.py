"""Tutorial: the dynamics ratio in another algorithm, here TorchRL's SACLoss. Takes one to two minutes.

python recipes/tutorials/weight_another_algorithm.py

A simulator that is wrong in some states gives wrong transitions there. The dynamics ratio weights each simulated
transition by how likely it is in reality; `ImportanceWeightedLoss` applies that weight to any TorchRL loss.
"""

# %% The task: Gymnasium's InvertedPendulum; the simulator has 1.5 times its gravity.
import torchrl_h2o.quiet  # noqa: F401, I001  (must precede the packages that it silences)

import sys

import torch
from torchrl.collectors import Collector
from torchrl.envs import DoubleToFloat, GymEnv, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SACLoss, SoftUpdate
from tqdm import tqdm

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.effects import Gravity
from torchrl_h2o.envs import DynamicsGap, record
from torchrl_h2o.objectives import (
    DynamicsRatioLoss,
    ImportanceWeightedLoss,
    make_actor,
    make_dynamics_ratio_estimator,
    make_qvalue,
)

UPDATES = int(sys.argv[1]) if len(sys.argv) > 1 else 2000


def make_env(gravity):
    return TransformedEnv(TransformedEnv(GymEnv("InvertedPendulum-v5"), DynamicsGap(Gravity(gravity))), DoubleToFloat())


# %% The real data: a noisy controller that balances for some two seconds.
def controller(step):
    gains = torch.tensor([0.5, 4.0, 0.5, 0.5])
    return step.set("action", (step["observation"] @ gains + 0.5 * torch.randn(1)).clamp(-3.0, 3.0))


torch.manual_seed(0)
reality, simulator = make_env(gravity=1.0), make_env(gravity=1.5)
real = record(reality, controller, 3000, seed=0, progress=False)
replay = HybridReplayBuffer(real, sim_capacity=30_000, batch_size=(64, 64))

# %% The algorithm: TorchRL's SACLoss. With reduction="none" it returns one term per row, so that rows can be weighted.
actor = make_actor(4, simulator.action_spec, (64, 64))
sac = SACLoss(actor, make_qvalue(4, 1, (64, 64)), reduction="none", scalar_output_mode="exclude")
sac.make_value_estimator(gamma=0.99)

# %% The weight. Only the Bellman error needs it: the policy may be improved in any state. Rows marked
# `real` keep weight 1.
loss = ImportanceWeightedLoss(sac, terms=["loss_qvalue"])

# %% The ratio. Two discriminators, trained together with the algorithm, classify transitions as real or simulated. One
# reads (s, a), the other (s, a, s'); the difference of their log-odds is log P(s'|s, a) / P̂(s'|s, a).
estimator = make_dynamics_ratio_estimator(4, 1, (64, 64))
ratio_loss = DynamicsRatioLoss(estimator)

# %% Training. The estimator writes `dynamics_ratio` into the batch, where the weighted loss reads it.
optimiser = torch.optim.Adam([*loss.parameters(), *ratio_loss.parameters()], lr=2e-3)
targets = SoftUpdate(loss, tau=0.02)
for steps in tqdm(Collector(simulator, actor, frames_per_batch=100, total_frames=UPDATES), unit=" epochs"):
    replay.extend(steps)
    for _ in range(100):
        batch = estimator(replay.sample())
        losses = {**loss(batch), **ratio_loss(batch)}
        optimiser.zero_grad()
        sum(term for name, term in losses.items() if name.startswith("loss_")).backward()
        optimiser.step()
        targets.step()

# %% The result: the mean weight of the simulated rows in the last batch, and the policy's return in reality. A small
# weight means that the discriminators distinguish simulated from real rows; then the real data dominate the Bellman
# error.
with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
    returns = [reality.rollout(1000, actor)["next", "reward"].sum().item() for _ in range(5)]
print(f"mean weight of simulated rows {batch['dynamics_ratio'][~batch['real']].mean():.2f}")
print(f"return in reality {sum(returns) / 5:.0f} of 1000; of the data {3000 / int(real['next', 'done'].sum()):.0f}")
