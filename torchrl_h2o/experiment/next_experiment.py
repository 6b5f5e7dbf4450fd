"""Designs the next experiment for a report: commands that tell apart what it leaves open, or narrow its values."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from tqdm import tqdm

from torchrl_h2o.experiment.design import Setting, best_commands
from torchrl_h2o.experiment.expected import told_apart
from torchrl_h2o.experiment.experiment import Experiment, experiment_of
from torchrl_h2o.experiment.limits import Envelope, Limits, servos, state_at_rest
from torchrl_h2o.experiment.separation import Explained, Yardstick
from torchrl_h2o.experiment.shown import further_effects
from torchrl_h2o.residuals.estimated_states import sensor_noise
from torchrl_h2o.residuals.ground import Ground
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.offered import offered_entries
from torchrl_h2o.residuals.report.contents import ReportContents
from torchrl_h2o.residuals.report.sampling import explanations_of, sample
from torchrl_h2o.residuals.search import known_set
from torchrl_h2o.residuals.simulation.simulation import Simulation

FOR_COMMANDS = 0.8  # share of the progress bar for the search of commands
GUARDS = 8  # draws of explanations and values that must keep the limits, too
MOST_EXPLANATIONS = 5  # the likeliest, between which an experiment decides


def next_experiment(
    simulator: EnvBase | Simulation,
    data: TensorDictBase,
    report: ReportContents,
    envelope: Envelope = Envelope(),  # noqa: B008 (frozen)
    *,
    minutes: float = 1.0,
    seed: int = 0,
    progress: bool = True,
) -> Experiment:
    """Designs commands under which the explanations that a report leaves open predict motions that differ most.

    Explanations differ in nats: the log likelihood ratio by the score of the search, relative to the errors that it
    found usual, after the rival's values were fitted to both logs. If one explanation is left, the commands are
    D-optimal, with a smaller weight for effects that are not in it: they shrink the volume in which its values lie
    (V. V. Fedorov, *Theory of Optimal Experiments*, 1972). To tell models apart by the motion in which they differ most
    is T-optimal design (A. C. Atkinson and V. V. Fedorov, *Biometrika* 62, 1975).

    Args:
        simulator: the simulator that the report is about.
        data: the transitions that it was made from, (T,), in TED.
        report: the report.
        envelope: what the experiment may use.
        minutes: time to search for commands, in minutes of the CPU.
        seed: seed of the candidates.
        progress: whether to show a progress bar.

    Returns:
        The experiment. Its commands begin and end at those at rest. It keeps the limits under every explanation, with
        some values drawn from the intervals, and in the simulator without effects.

    Raises:
        ValueError: if the report has no effects, the machine does not come to rest, or no commands keep the limits.
    """
    rng = np.random.default_rng(seed)
    setting = setting_of(simulator, data, report, envelope, rng)
    with designing(progress) as show:
        knots = best_commands(setting, rng, 60.0 * minutes, show=lambda share: show(FOR_COMMANDS * share))
        apart = told_apart(
            setting, data, knots, rng, show=lambda share: show(FOR_COMMANDS + (1 - FOR_COMMANDS) * share)
        )
    return experiment_of(setting, knots, apart)


@contextmanager
def designing(progress: bool) -> Iterator[Callable[[float], None]]:
    """A progress bar, as a function of the share that is done."""
    with tqdm(total=100, desc="designing", unit="%", disable=not progress) as bar:

        def show(share: float) -> None:
            bar.n = min(100, round(100.0 * share))
            bar.refresh()

        yield show


def setting_of(
    simulator: EnvBase | Simulation,
    data: TensorDictBase,
    report: ReportContents,
    envelope: Envelope,
    rng: np.random.Generator,
) -> Setting:
    """What an experiment is designed for; the arguments and errors are those of :func:`next_experiment`."""
    simulation = simulator if isinstance(simulator, Simulation) else Simulation.from_env(simulator)
    if not report.found:
        raise ValueError("the report has found no effects, so there is nothing that an experiment could decide")
    measured = Measured.from_ted(data, simulation)
    ground, explanations = explanations_to_tell_apart(simulation, measured, report)
    command, noise = command_at_rest(simulation, measured), sensor_noise(explanations[0].simulation, measured)
    rest = state_at_rest(explanations[0].simulation, simulation.state_map.states(measured.observation[:1])[0], command)
    return Setting(
        explanations=explanations,
        yard=Yardstick.of(ground),
        limits=Limits.around(simulation, rest, measured.action, envelope),
        rest=rest,
        command=command,
        steps=round(envelope.seconds / simulation.control_step),
        band=envelope.band,
        noise=np.zeros(len(simulation.state_map.names)) if noise is None else noise,
        unknown=further_effects(explanations[0]),
        guards=guards_of(simulation, report, int(rng.integers(2**31))),
    )


def explanations_to_tell_apart(
    simulation: Simulation, measured: Measured, report: ReportContents
) -> tuple[Ground, list[Explained]]:
    """The report's explanation and its rivals, fitted to the log: those of the catalogue, and at most a few."""
    catalogue = offered_entries(simulation)
    sets = [known_set(catalogue, [effect for effect, _ in fitted]) for fitted in explanations_of(report)]
    sets = [one for one in sets if one.entries][:MOST_EXPLANATIONS]
    if not sets:
        raise ValueError(
            "the report has no effect of this simulator's catalogue but noise: give the report's simulator"
        )
    ground = Ground.of(simulation, measured, sets[0].effects)
    return ground, [Explained.of(ground, ground.fitted(one.entries, one.effects)) for one in sets]


def guards_of(simulation: Simulation, report: ReportContents, seed: int) -> list[Simulation]:
    """The simulator as it is, and with values drawn from the report's explanations and their intervals."""
    found = [simulation]
    for effects in sample(report, GUARDS, seed=seed):
        drawn = simulation.with_effects(*effects)
        try:
            _ = drawn.model  # compiled here
        except ValueError:  # the model rejects these values together
            continue
        found.append(drawn)
    return found


def command_at_rest(simulation: Simulation, measured: Measured) -> np.ndarray:
    """The command under which the machine rests, (nu): the first one of servos, otherwise none."""
    model = simulation.model
    command = np.where(servos(simulation), measured.action[0], 0.0)
    limited = model.actuator_ctrllimited.astype(bool)
    low, high = model.actuator_ctrlrange.T
    return np.where(limited, np.clip(command, low, high), command)
