"""Weights TorchRL's TD3Loss by the dynamics ratio: simulated rows that are unlikely in reality get a small weight.

python recipes/weighted_td3.py               # a minute
python recipes/weighted_td3.py --unweighted  # the same without the ratio

`ImportanceWeightedLoss` wraps any TorchRL loss built with reduction="none".
Reality is Gymnasium's InvertedPendulum, recorded under a noisy controller; the simulator has twice its gravity.
"""

import torchrl_h2o.quiet  # noqa: F401, I001  (must precede the packages that it silences)

import argparse

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import DoubleToFloat, EnvBase, GymEnv, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SoftUpdate, TD3Loss
from tqdm import tqdm

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.effects import Effect, Gravity
from torchrl_h2o.envs import DynamicsGap, record
from torchrl_h2o.objectives import (
    DynamicsRatioLoss,
    ImportanceWeightedLoss,
    make_actor,
    make_dynamics_ratio_estimator,
    make_qvalue,
)

GAINS = torch.tensor([0.5, 4.0, 0.5, 0.5])  # of position, angle and their velocities
WIDTHS = (64, 64)  # hidden layers


def make_env(*effects: Effect) -> EnvBase:
    env = TransformedEnv(GymEnv("InvertedPendulum-v5"), DynamicsGap(*effects))
    return TransformedEnv(env, DoubleToFloat())


def noisy_controller(step: TensorDictBase) -> TensorDictBase:
    return step.set("action", (step["observation"] @ GAINS + 0.5 * torch.randn(1)).clamp(-3.0, 3.0))


def mean_return(env: EnvBase, policy: torch.nn.Module, episodes: int = 5) -> float:
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        return sum(env.rollout(1000, policy)["next", "reward"].sum().item() for _ in range(episodes)) / episodes


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--unweighted", action="store_true", help="give all simulated rows weight 1")
parser.add_argument("--updates", type=int, default=3000, help="one simulated step each")
parser.add_argument("--seed", type=int, default=0)
args = parser.parse_args()
torch.manual_seed(args.seed)

reality, simulator = make_env(), make_env(Gravity(2.0))
real = record(reality, noisy_controller, 3000, args.seed, progress=False)
replay = HybridReplayBuffer(real, sim_capacity=30_000, batch_size=(64, 64))

actor = make_actor(4, simulator.action_spec, WIDTHS)  # TD3 trains the mean; the untrained std is for exploration
qvalues = [make_qvalue(4, 1, WIDTHS) for _ in range(2)]
estimator = make_dynamics_ratio_estimator(4, 1, WIDTHS)
td3 = TD3Loss(actor, qvalues, action_spec=simulator.action_spec, loss_function="l2", reduction="none")
td3.make_value_estimator(gamma=0.99)
loss = ImportanceWeightedLoss(td3, terms=["loss_qvalue"])  # only the Bellman error is weighted, as in Eq. (8)
ratio_loss = DynamicsRatioLoss(estimator)
optimiser = torch.optim.Adam([*loss.parameters(), *ratio_loss.parameters()], lr=2e-3)
targets = SoftUpdate(loss, tau=0.02)

for steps in tqdm(Collector(simulator, actor, frames_per_batch=100, total_frames=args.updates), unit="00 updates"):
    replay.extend(steps)
    for _ in range(100):
        batch = estimator(replay.sample())  # writes dynamics_ratio, Eq. (9)
        if args.unweighted:
            batch["dynamics_ratio"] = torch.ones_like(batch["dynamics_ratio"])
        losses = {**loss(batch), **ratio_loss(batch)}
        optimiser.zero_grad()
        sum(term for name, term in losses.items() if name.startswith("loss_")).backward()
        optimiser.step()
        targets.step()

print(f"\nreturn in reality, of at most 1000\n  TD3  {mean_return(reality, actor):6.0f}")
print(f"  data {len(real) / int(real['next', 'done'].sum()):6.0f}")
