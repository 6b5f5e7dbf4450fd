"""Tutorial: replace the value backbone, also by your own. Takes one to two minutes.

python recipes/tutorials/swap_a_backbone.py

V(s) is fitted to Q(s, a) at the actions in the real data. The backbone decides how positive and negative advantages
are weighted.
"""

# %% The task: Gymnasium's InvertedPendulum; the simulator has 1.5 times its gravity.
import torchrl_h2o.quiet  # noqa: F401, I001  (must precede the packages that it silences)

import sys

import torch
from torchrl.collectors import Collector
from torchrl.envs import DoubleToFloat, GymEnv, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SoftUpdate
from tqdm import tqdm

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.effects import Gravity
from torchrl_h2o.envs import DynamicsGap, record
from torchrl_h2o.objectives import (
    DynamicsRatioLoss,
    ExpectileValueLoss,
    H2OPlusLoss,
    InSampleValueLoss,
    MixedBellmanLoss,
    SparseValueLoss,
    make_actor,
    make_dynamics_ratio_estimator,
    make_qvalue,
    make_value,
)

UPDATES = int(sys.argv[1]) if len(sys.argv) > 1 else 1000  # of each backbone


def make_env(gravity):
    return TransformedEnv(TransformedEnv(GymEnv("InvertedPendulum-v5"), DynamicsGap(Gravity(gravity))), DoubleToFloat())


# %% The real data: a noisy controller that balances for some two seconds.
def controller(step):
    gains = torch.tensor([0.5, 4.0, 0.5, 0.5])
    return step.set("action", (step["observation"] @ gains + 0.5 * torch.randn(1)).clamp(-3.0, 3.0))


reality = make_env(gravity=1.0)
real = record(reality, controller, 3000, seed=0, progress=False)


# %% To write your own backbone, define one method, `penalty`: the loss of an advantage y = Q(s, a) - V(s). The one
# below fits V to the mean, but is linear for advantages with |y| > 1.
class HuberValueLoss(InSampleValueLoss):
    def penalty(self, advantage):
        return torch.nn.functional.huber_loss(advantage, torch.zeros_like(advantage), reduction="none")


BACKBONES = {
    "expectile (IQL)": lambda value: ExpectileValueLoss(value, expectile=0.7),
    "sparse (SQL)": lambda value: SparseValueLoss(value, alpha=1.0),
    "Huber (ours)": HuberValueLoss,
}


# %% One training run. The backbone is one argument of H2OPlusLoss; nothing else depends on it. `mixing` is the weight
# of V(s') in the target of Q, so the backbone has more influence with a larger `mixing`.
def train(backbone):
    torch.manual_seed(0)
    simulator, widths = make_env(gravity=1.5), (64, 64)
    replay = HybridReplayBuffer(real, sim_capacity=30_000, batch_size=(64, 64))
    actor, value = make_actor(4, simulator.action_spec, widths), make_value(4, widths)
    bellman = MixedBellmanLoss(actor, [make_qvalue(4, 1, widths) for _ in range(2)], value, mixing=0.1)
    ratio_loss = DynamicsRatioLoss(make_dynamics_ratio_estimator(4, 1, widths))
    loss = H2OPlusLoss(bellman, value_loss=backbone(value), ratio_loss=ratio_loss)
    optimiser, targets = torch.optim.Adam(loss.parameters(), lr=2e-3), SoftUpdate(loss, tau=0.02)
    for steps in tqdm(Collector(simulator, actor, frames_per_batch=100, total_frames=UPDATES), unit=" epochs"):
        replay.extend(steps)
        for _ in range(100):
            losses = loss(replay.sample())
            optimiser.zero_grad()
            sum(term for name, term in losses.items() if name.startswith("loss_")).backward()
            optimiser.step()
            targets.step()
    return actor


# %% The result in reality. So few updates are not enough to rank the backbones; they only show that each one trains.
for name, backbone in BACKBONES.items():
    policy = train(backbone)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        returns = [reality.rollout(1000, policy)["next", "reward"].sum().item() for _ in range(3)]
    print(f"{name:<16} return in reality {sum(returns) / 3:5.0f} of 1000")
