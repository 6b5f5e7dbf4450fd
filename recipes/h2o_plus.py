"""Trains H2O+ from real data and an imperfect simulator, and evaluates the policy in reality.

python recipes/h2o_plus.py                                             # the wheel-legged robot, nothing downloaded
python recipes/h2o_plus.py mend=false warm_start=false keep=last       # H2O+ alone
python recipes/h2o_plus.py data=standing_still.txt                     # with the real robot's log
python recipes/h2o_plus.py env=halfcheetah gap=gravity data=halfcheetah/medium-replay-v0
python recipes/h2o_plus.py env=halfcheetah mend=true data=...          # first adds what the simulator lacks to it
python recipes/h2o_plus.py ratio_estimator=pairs                       # another estimator of the dynamics ratio
python recipes/h2o_plus.py backbone=sparse mixing=0.5 ratio=false      # --help lists the options
python recipes/h2o_plus.py resume=outputs/wheel_legged/...             # continue an interrupted run

Other methods, baselines, many runs at once and simulators in worker processes: recipes/train.py.
"""

import torchrl_h2o.quiet  # noqa: F401, I001  (before the packages whose warnings it silences)

import time
from pathlib import Path

import torch
from omegaconf import DictConfig
from torch.optim.lr_scheduler import LinearLR
from torchrl.objectives import SoftUpdate

from torchrl_h2o.commands.hydra_main import hydra_main
from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.objectives import H2OPlusLoss, MixedBellmanLoss, make_actor, make_qvalue, total_loss
from torchrl_h2o.options import RunOptions
from torchrl_h2o.training.collection import simulated_transitions
from torchrl_h2o.training.compiling import maybe_compiled
from torchrl_h2o.training.divergence import DivergenceError
from torchrl_h2o.training.environments import keeps_best, sim_capacity_of
from torchrl_h2o.training.evaluators import evaluator_of
from torchrl_h2o.training.film import try_to_film
from torchrl_h2o.training.judging import judge, run_settings, table_of_run, write_failure
from torchrl_h2o.training.mending import find_missing_effects
from torchrl_h2o.training.methods.h2o_plus import make_value_loss
from torchrl_h2o.training.ongoing_episodes import OngoingEpisodes
from torchrl_h2o.training.preprocessing import Preprocessing
from torchrl_h2o.training.progress import Budget, Training, epoch_seed
from torchrl_h2o.training.ratio import make_pairs, make_ratio_loss
from torchrl_h2o.training.returns import BestPolicy
from torchrl_h2o.training.run_folder import claimed, open_run, resumable, save_config
from torchrl_h2o.training.task import Task
from torchrl_h2o.training.warm_start import begin, held_updates, hold


@hydra_main("config", "h2o_plus", RunOptions)
def main(cfg: DictConfig) -> None:
    cfg, folder = open_run(cfg)
    with claimed(folder), resumable(folder):
        train(cfg, folder)


def train(cfg: DictConfig, folder: Path) -> None:
    """Trains, evaluates in reality, and writes summary.json, metrics.csv, learning_curve.png and a film."""
    start = time.perf_counter()

    # Task: the target dynamics (reality), and a simulator with the dynamics gap
    task = Task.from_config(cfg.env, gap=cfg.gap, gap_strength=cfg.gap_strength)
    task.make_simulator()  # fails before the data are loaded if an effect does not fit the model

    # Data: real transitions in TED, [T]; both streams have the same preprocessing of observations and rewards
    real = task.read_real_data(cfg.data, cfg.columns, cfg.data_seconds)
    cfg.mended = find_missing_effects(cfg, task, real, folder)  # null unless mend=true or mend=posterior
    task = task.mended(cfg.mended)
    preprocessing = Preprocessing.fit(
        real,
        normalise=cfg.normalise_observation,
        norm=cfg.observation_norm,
        frames=cfg.frames,
        action_history=cfg.action_history,
        reward_scale=cfg.reward_scale,
        reward_offset=cfg.reward_offset,
    )
    cfg.observation_norm = preprocessing.norm
    save_config(cfg, folder)
    shown = preprocessing.apply(real)
    replay = HybridReplayBuffer(
        shown,
        sim_capacity=sim_capacity_of(cfg, len(real)),
        batch_size=cfg.batch_size,
        n_steps=cfg.n_steps,
        gamma=cfg.gamma,
    )

    # Environment in which transitions are collected
    simulator = task.make_training_simulator(cfg.num_worlds, preprocessing)
    observation_dim = simulator.observation_spec["observation"].shape[-1]
    action_spec = simulator.action_spec_unbatched
    action_dim = action_spec.shape[-1]

    # Networks
    torch.manual_seed(cfg.seed)
    actor = make_actor(observation_dim, action_spec, cfg.num_cells)
    qvalues = make_qvalue(
        observation_dim, action_dim, cfg.num_cells, layer_norm=cfg.layer_norm, ensemble=cfg.num_qvalue_nets
    )
    begin(cfg, actor, action_spec, replay)  # with warm_start, at the behaviour in the real data or an earlier policy

    # Losses: Eq. (4) trains V, Eqs. (7) and (8) Q, Eq. (9) the discriminators, Eq. (10) the policy
    value_loss = make_value_loss(cfg, observation_dim)  # with V; expectile, sparse or exponential
    ratio_loss = make_ratio_loss(cfg, observation_dim, action_dim, replay, delayed=True)
    pairs_replay = make_pairs(cfg, task, real, preprocessing, replay) or replay  # trains the discriminators
    bellman_loss = MixedBellmanLoss(actor, qvalues, value_loss.value_network, mixing=cfg.mixing)
    loss = H2OPlusLoss(bellman_loss, value_loss, ratio_loss, weighted=cfg.ratio, target_entropy=cfg.target_entropy)
    loss.make_value_estimator(gamma=cfg.gamma)
    loss_fn = maybe_compiled(loss, cfg.compiled, cfg.updates, parameters=loss.parameters())

    # Optimiser, target networks, and the collector of simulated transitions
    budget = Budget(cfg.updates, cfg.updates_per_epoch, cfg.eval_every, cfg.checkpoint_every)
    optimiser = torch.optim.Adam(loss.parameters(), lr=cfg.lr, fused=True)
    schedule = LinearLR(optimiser, 1.0, cfg.lr_end_factor, total_iters=budget.epochs)
    targets = SoftUpdate(loss, tau=cfg.tau)
    collector = simulated_transitions(simulator, actor, cfg.steps_per_epoch)
    rollouts, episodes = iter(collector), OngoingEpisodes(collector)

    # Contents of a checkpoint; with keep=best_in_simulator also the policy with the highest return in the simulator
    parts = {"actor": actor, "loss": loss, "optimiser": optimiser, "schedule": schedule}
    parts |= {"replay": replay, "episodes": episodes}
    best = BestPolicy(actor) if keeps_best(cfg) else None
    if best is not None:
        parts["policy"] = best.policy
    evaluator = evaluator_of(cfg, task, preprocessing, best)  # with overlap=true beside the next updates
    training = Training("H2O+", folder, budget, **parts)
    setup_s = time.perf_counter() - start

    # Training
    try:
        for epoch, evaluating in training.epochs():
            # Every epoch has its own random stream, so that a resumed run draws the numbers of an uninterrupted one
            seed = epoch_seed(cfg.seed, epoch)
            torch.manual_seed(seed)

            # Collect
            episodes.begin_epoch(epoch, seed)
            collector.update_policy_weights_()
            simulated = next(rollouts)
            simulated["next", "reward"] = preprocessing.reward(simulated["next", "reward"])
            replay.extend(simulated)

            # Update
            held = held_updates(cfg) - epoch * cfg.updates_per_epoch
            for update in training.epoch_updates():
                batch = replay.sample(cfg.batch_size)
                pairs = pairs_replay.sample(cfg.discriminator_batch_size)
                losses = loss_fn(batch, pairs)
                training.check(losses)  # a loss that is not finite ends the run, and the last checkpoint stays
                optimiser.zero_grad()
                total_loss(losses).backward()
                if update < held:
                    hold(actor.parameters(), optimiser)
                optimiser.step()
                targets.step()
            schedule.step()

            # Evaluate
            if evaluating:
                training.evaluate(
                    evaluator,
                    actor,
                    epoch,
                    ratio_of_sim=float(ratio_loss.dynamics_ratio(batch)[~batch["real"]].mean()),
                    **{name: term.item() for name, term in losses.items()},
                )
    except DivergenceError as error:
        write_failure(folder, error.failure, run_settings(cfg, real))
        raise
    finally:
        evaluator.close()
        collector.shutdown()

    # Results
    policy = actor if best is None else best.policy
    wall_s = setup_s + training.progress["seconds"]
    in_reality = judge(cfg, real, {"H2O+": policy}, {"H2O+": training}, folder, wall_s)
    film = try_to_film(task, preprocessing, policy, folder) if cfg.render else None
    print(table_of_run(in_reality, folder, film, task.seconds_per_step))


if __name__ == "__main__":
    main()
