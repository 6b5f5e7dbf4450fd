"""Trains H2O+ with one of its three value backbones; the backbone is one argument of the loss.

python recipes/swap_backbone.py                          # expectile (IQL), a minute
python recipes/swap_backbone.py --backbone sparse        # SQL
python recipes/swap_backbone.py --backbone exponential   # EQL

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
    ExpectileValueLoss,
    ExponentialValueLoss,
    H2OPlusLoss,
    MixedBellmanLoss,
    SparseValueLoss,
    make_actor,
    make_dynamics_ratio_estimator,
    make_qvalue,
    make_value,
)

BACKBONES = {
    "expectile": lambda value: ExpectileValueLoss(value, expectile=0.7),
    "sparse": lambda value: SparseValueLoss(value, alpha=1.0),
    "exponential": lambda value: ExponentialValueLoss(value, alpha=1.0),
}
GAINS = torch.tensor([0.5, 4.0, 0.5, 0.5])  # of position, angle and their velocities
WIDTHS = (64, 64)  # hidden layers


def make_env(*effects: Effect) -> EnvBase:
    env = TransformedEnv(GymEnv("InvertedPendulum-v5"), DynamicsGap(*effects))
    return TransformedEnv(env, DoubleToFloat())


def noisy_controller(step: TensorDictBase) -> TensorDictBase:
    """Balances for about 2 s per episode; the noise makes the data cover more states."""
    return step.set("action", (step["observation"] @ GAINS + 0.5 * torch.randn(1)).clamp(-3.0, 3.0))


def mean_return(env: EnvBase, policy: torch.nn.Module, episodes: int = 5) -> float:
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        return sum(env.rollout(1000, policy)["next", "reward"].sum().item() for _ in range(episodes)) / episodes


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--backbone", choices=BACKBONES, default="expectile")
parser.add_argument("--updates", type=int, default=3000, help="one simulated step each")
parser.add_argument("--seed", type=int, default=0)
args = parser.parse_args()
torch.manual_seed(args.seed)

# Data: measured transitions beside the simulator's replay buffer
reality, simulator = make_env(), make_env(Gravity(2.0))
real = record(reality, noisy_controller, 3000, args.seed, progress=False)
replay = HybridReplayBuffer(real, sim_capacity=30_000, batch_size=(64, 64))

# Networks and loss
actor = make_actor(4, simulator.action_spec, WIDTHS)
qvalues = [make_qvalue(4, 1, WIDTHS) for _ in range(2)]
value = make_value(4, WIDTHS)
loss = H2OPlusLoss(
    MixedBellmanLoss(actor, qvalues, value, mixing=0.1),
    value_loss=BACKBONES[args.backbone](value),
    ratio_loss=DynamicsRatioLoss(make_dynamics_ratio_estimator(4, 1, WIDTHS)),
)
optimiser = torch.optim.Adam(loss.parameters(), lr=2e-3)
targets = SoftUpdate(loss, tau=0.02)

# Training: 100 simulated steps, then 100 updates, repeated
collector = Collector(simulator, actor, frames_per_batch=100, total_frames=args.updates)
with tqdm(total=args.updates, unit=" updates") as bar:
    for steps in collector:
        replay.extend(steps)
        for _ in range(100):
            losses = loss(replay.sample())
            optimiser.zero_grad()
            sum(term for name, term in losses.items() if name.startswith("loss_")).backward()
            optimiser.step()
            targets.step()
        bar.update(100)

print(f"\nreturn in reality, of at most 1000\n  {args.backbone:<12} {mean_return(reality, actor):6.0f}")
print(f"  {'data':<12} {len(real) / int(real['next', 'done'].sum()):6.0f}")
