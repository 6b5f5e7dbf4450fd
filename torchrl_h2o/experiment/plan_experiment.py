"""Plans the first experiment: which effects of the catalogue it would show, from which size, before there is a log."""

from __future__ import annotations

import numpy as np
from torchrl.envs import EnvBase

from torchrl_h2o.experiment.design import Setting, best_commands
from torchrl_h2o.experiment.experiment import Experiment, experiment_of
from torchrl_h2o.experiment.limits import Envelope, Limits, servos, state_at_rest
from torchrl_h2o.experiment.next_experiment import designing
from torchrl_h2o.experiment.separation import Explained, Yardstick
from torchrl_h2o.experiment.shown import further_effects
from torchrl_h2o.residuals.simulation.simulation import Simulation


def plan_experiment(
    simulator: EnvBase | Simulation,
    envelope: Envelope = Envelope(),  # noqa: B008 (frozen)
    *,
    noise: float = 1e-3,
    minutes: float = 1.0,
    seed: int = 0,
    progress: bool = True,
) -> Experiment:
    """Designs the commands of a first log, under which as many effects of the catalogue as possible would show.

    An effect would show if predictions without it, from known states, were expected to be refuted by the readings of
    encoders with this noise: by a log likelihood ratio of log 100, and more if it is unusual, as in the search. This is
    T-optimal design (A. C. Atkinson and V. V. Fedorov, *Biometrika* 62, 1975) of the simulator against each simulator
    with one effect at a usual size. Two effects look alike if one changes the readings as the other does. A search has
    to estimate the states as well, so it needs somewhat larger effects.

    Args:
        simulator: the simulator, without a log.
        envelope: what the experiment may use.
        noise: standard deviation of the noise of the encoders, in rad or m.
        minutes: time to search for commands, in minutes of the CPU.
        seed: seed of the candidates.
        progress: whether to show a progress bar.

    Returns:
        The experiment; its field ``shown`` has the effects. Its commands begin and end at those at rest.

    Raises:
        ValueError: if an actuator has no range, the machine does not come to rest, or no commands keep the limits.
    """
    simulation = simulator if isinstance(simulator, Simulation) else Simulation.from_env(simulator)
    model, rng = simulation.model, np.random.default_rng(seed)
    unlimited = [simulation.actuators[index] for index in np.flatnonzero(~model.actuator_ctrllimited.astype(bool))]
    if unlimited:
        raise ValueError(
            f"actuators without a range of commands: {', '.join(unlimited)}; give each a ctrlrange in the model"
        )
    command = np.clip(np.where(servos(simulation), model.actuator_length0, 0.0), *model.actuator_ctrlrange.T)
    rest = state_at_rest(simulation, np.concatenate([model.qpos0, np.zeros(model.nv)]), command)
    first = Explained.nothing(simulation)
    setting = Setting(
        explanations=[first],
        yard=Yardstick.of_encoders(simulation, noise),
        limits=Limits.around(simulation, rest, command[None], envelope),
        rest=rest,
        command=command,
        steps=round(envelope.seconds / simulation.control_step),
        band=envelope.band,
        noise=np.zeros(len(simulation.state_map.names)),
        unknown=further_effects(first),
    )
    with designing(progress) as show:
        knots = best_commands(setting, rng, 60.0 * minutes, show=show)
    return experiment_of(setting, knots, np.ones((1, 1)))
