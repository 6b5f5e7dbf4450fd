"""An experiment: commands for a machine, and what they are expected to show."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torchrl_h2o.experiment.design import Setting
from torchrl_h2o.experiment.expected import Narrowing, narrowed
from torchrl_h2o.experiment.separation import predicted
from torchrl_h2o.experiment.shown import Shown, shown_effects
from torchrl_h2o.residuals.report.words import effect_words, quantity
from torchrl_h2o.residuals.simulation.simulation import Simulation

LISTED = 12  # effects that the words list


@dataclass(frozen=True, eq=False)
class Experiment:
    """Commands for a machine, and what they are expected to show.

    Args:
        commands: (T, nu), in the order of the actuators.
        explanations: the effects of each explanation in words, the likeliest first.
        motions: predicted readings of each explanation, (K, T + 1, n).
        simulator: that of the likeliest explanation, with the control step and the names and units of both.
        states: its motion, before each command and after the last one, (T + 1, nq + nv).
        nats: by how much the predictions of the others differ, in nats for each block of control steps, (blocks).
        block_seconds: duration of a block, in s.
        told_apart: probability that the data tell a true explanation (row) from a rival (column), (K, K).
        narrowing: the values of the likeliest explanation.
        shown: the effects of the catalogue that are not in it, the most usual first.
    """

    commands: np.ndarray
    explanations: tuple[tuple[str, ...], ...]
    motions: np.ndarray
    simulator: Simulation
    states: np.ndarray
    nats: np.ndarray
    block_seconds: float
    told_apart: np.ndarray
    narrowing: tuple[Narrowing, ...]
    shown: tuple[Shown, ...]

    @property
    def seconds(self) -> float:
        """Duration, in s."""
        return len(self.commands) * self.simulator.control_step

    def save(self, folder: str | Path) -> None:
        """Writes ``commands.csv``, ``experiment.json``, a page, and a film of the motion if MuJoCo can render here."""
        from torchrl_h2o.experiment.files import write_files

        write_files(self, Path(folder))

    def words(self) -> str:
        """The expected verdict in words."""
        count = len(self.explanations)
        if not self.explanations[0]:
            return self._words_of_plan()
        if count == 1:
            shares = ", ".join(f"{one.words} to {one.share:.0%}" for one in self.narrowing)
            told = "The report leaves no other explanation open. The experiment narrows its intervals"
            return f"{told}: {shares} of their width."
        lines = []
        for rival in range(1, count):
            both = self.told_apart[0, rival], self.told_apart[rival, 0]
            lines.append(f"  {min(both):.0%}  {', '.join(self.explanations[rival])}")
        return "\n".join([f"{', '.join(self.explanations[0])}\nis told apart with a probability of", *lines])

    def _words_of_plan(self) -> str:
        """Which effects would show, in words."""
        seen, hidden = ([one for one in self.shown if one.is_shown == which] for which in (True, False))
        lines = [
            f"{quantity(self.seconds, 's')} of these commands would show, from known states and from this size on:"
        ]
        lines += [f"  {one.words}" + (f"    (looks like {one.alike})" if one.alike else "") for one in seen[:LISTED]]
        lines += [f"  and {len(seen) - LISTED} more"] if len(seen) > LISTED else []
        lines += ["They would not show, for example:"] if hidden else []
        lines += [f"  {one.words}" for one in hidden[:LISTED]]
        lines += [f"  and {len(hidden) - LISTED} more"] if len(hidden) > LISTED else []
        return "\n".join(lines)


def experiment_of(setting: Setting, knots: np.ndarray, apart: np.ndarray) -> Experiment:
    """The experiment with some commands, and what it is expected to show."""
    simulation, explanations = setting.base, setting.explanations
    words = tuple(tuple(effect_words(effect, simulation.names) for effect in one.found.effects) for one in explanations)
    motions = [setting.motion(index, knots) for index in range(len(explanations))]
    first, *others = (predicted(one.simulation, motions[0], setting.yard) for one in explanations)
    nats = [((other - first) ** 2).mean(1).sum(1) / 2.0 for other in others]
    return Experiment(
        commands=setting.commands(knots),
        explanations=words,
        motions=np.stack([motion.readings for motion in motions]),
        simulator=explanations[0].simulation,
        states=motions[0].states,
        nats=np.mean(nats, axis=0) if nats else np.zeros(len(first)),
        block_seconds=setting.yard.steps * simulation.control_step,
        told_apart=apart,
        narrowing=narrowed(setting, knots),
        shown=shown_effects(setting, knots),
    )
