"""Composes the losses of H2O+ by hand, with a new value backbone and a fixed temperature.

python recipes/compose_losses.py               # a minute
python recipes/compose_losses.py --mixing 0.5  # a larger weight of V(s') in the target, a smaller one of the policy's Q

`H2OPlusLoss` combines the same losses. Use them one by one to replace one, or to train some more often than others.
Reality is Gymnasium's InvertedPendulum, recorded under a noisy controller; the simulator has twice its gravity.
"""

import torchrl_h2o.quiet  # noqa: F401, I001  (must precede the packages that it silences)

import argparse

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import DoubleToFloat, EnvBase, GymEnv, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SoftUpdate
from tqdm import tqdm

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.effects import Effect, Gravity
from torchrl_h2o.envs import DynamicsGap, record
from torchrl_h2o.objectives import (
    DynamicsRatioLoss,
    InSampleValueLoss,
    MixedBellmanLoss,
    make_actor,
    make_dynamics_ratio_estimator,
    make_qvalue,
    make_value,
)

GAINS = torch.tensor([0.5, 4.0, 0.5, 0.5])  # of position, angle and their velocities
WIDTHS = (64, 64)  # hidden layers


class HuberExpectileLoss(InSampleValueLoss):
    """IQL's expectile loss, but linear for large advantages, so that a few outliers do not dominate."""

    def penalty(self, advantage: torch.Tensor) -> torch.Tensor:
        weight = torch.where(advantage > 0, 0.7, 0.3)
        return weight * torch.nn.functional.huber_loss(advantage, torch.zeros_like(advantage), reduction="none")


def make_env(*effects: Effect) -> EnvBase:
    env = TransformedEnv(GymEnv("InvertedPendulum-v5"), DynamicsGap(*effects))
    return TransformedEnv(env, DoubleToFloat())


def noisy_controller(step: TensorDictBase) -> TensorDictBase:
    return step.set("action", (step["observation"] @ GAINS + 0.5 * torch.randn(1)).clamp(-3.0, 3.0))


def mean_return(env: EnvBase, policy: torch.nn.Module, episodes: int = 5) -> float:
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        return sum(env.rollout(1000, policy)["next", "reward"].sum().item() for _ in range(episodes)) / episodes


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--mixing", type=float, default=0.1, help="λ of Eq. (7)")
parser.add_argument("--updates", type=int, default=3000, help="one simulated step each")
args = parser.parse_args()
torch.manual_seed(0)

reality, simulator = make_env(), make_env(Gravity(2.0))
real = record(reality, noisy_controller, 3000, seed=0, progress=False)
replay = HybridReplayBuffer(real, sim_capacity=30_000, batch_size=(64, 64))

actor, value = make_actor(4, simulator.action_spec, WIDTHS), make_value(4, WIDTHS)
qvalues = [make_qvalue(4, 1, WIDTHS) for _ in range(2)]
bellman = MixedBellmanLoss(actor, qvalues, value, mixing=args.mixing, alpha_init=0.05)  # holds policy and Q, reads V
value_loss = HuberExpectileLoss(value)
ratio_loss = DynamicsRatioLoss(make_dynamics_ratio_estimator(4, 1, WIDTHS))
parts = torch.nn.ModuleList([bellman, value_loss, ratio_loss])  # V is in two modules; parameters() returns it once
optimiser = torch.optim.Adam(parts.parameters(), lr=2e-3)
targets = SoftUpdate(bellman, tau=0.02)

for steps in tqdm(Collector(simulator, actor, frames_per_batch=100, total_frames=args.updates), unit="00 updates"):
    replay.extend(steps)
    for _ in range(100):
        batch = replay.sample()
        ratio = ratio_loss(batch)  # Eq. (9), the discriminators
        batch["dynamics_ratio"] = ratio_loss.dynamics_ratio(batch)
        loss = ratio["loss_ratio_sa"] + ratio["loss_ratio_sas"] + bellman(batch)["loss_qvalue"]  # Eqs. (7) and (8)
        with torch.no_grad():  # V is fitted to the target Q at the actions in the data
            batch["state_action_value"] = bellman.qvalues(batch, bellman.target_qvalue_network_params).amin(0)
        loss = loss + value_loss(batch)["loss_value"]  # Eq. (4)
        batch["action"], log_prob = bellman.sample_action(batch.copy())
        qvalue = bellman.qvalues(batch, bellman.qvalue_network_params, frozen=True).amin(0)
        loss = loss + (bellman.alpha * log_prob - qvalue).mean()  # Eq. (10), the policy
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        targets.step()

print(f"\nreturn in reality, of at most 1000\n  composed {mean_return(reality, actor):6.0f}")
print(f"  data     {len(real) / int(real['next', 'done'].sum()):6.0f}")
