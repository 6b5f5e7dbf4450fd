"""Effects of the catalogue that an experiment would show, from which size, and which of them look alike."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from torchrl_h2o.effects.catalogue.plausibility import surprise
from torchrl_h2o.experiment.design import Setting
from torchrl_h2o.experiment.separation import Explained, Further
from torchrl_h2o.likelihood import ENOUGH
from torchrl_h2o.residuals.ground import NATS_OF_SURPRISE
from torchrl_h2o.residuals.offered import offered_entries
from torchrl_h2o.residuals.report.words import effect_words

APPROACHES = 4  # steps towards the smallest size
ALIKE = 0.9  # share of what an effect changes, above which another one changes it alike


@dataclass(frozen=True)
class Shown:
    """An effect that the simulator may lack, and whether an experiment would show it.

    Args:
        words: the effect at the smallest size that would show. Where no usual size would, and for a range or a limit,
            which has no smaller size: at a usual size.
        is_shown: whether a usual size would show.
        nats: expected log likelihood ratio for the usual size.
        alike: another effect, in words, that changes the predictions alike; None without one.
    """

    words: str
    is_shown: bool
    nats: float
    alike: str | None


def further_effects(first: Explained) -> tuple[Further, ...]:
    """The effects of the catalogue that are not in an explanation."""
    found = []
    for entry in offered_entries(first.base):
        if entry.effect.random or entry.name in first.found.names:
            continue
        trial = max(entry.trials, key=lambda one: sum(one.values()))  # more friction than in the model, not less
        further = Further(entry, entry.effect.with_parameters(trial), first.simulation)
        try:
            _ = further.simulation.model  # compiled here
        except ValueError:  # the model has no such element beside the effects found
            continue
        found.append(further)
    return tuple(found)


def shown_effects(setting: Setting, knots: np.ndarray) -> tuple[Shown, ...]:
    """What some commands would show of the effects that are not in the first explanation, the most usual first."""
    if not setting.unknown:
        return ()
    products, names = setting.overlaps(knots), setting.base.names
    nats = np.maximum(products.diagonal(), 1e-12)
    shares = products**2 / np.outer(nats, nats)
    np.fill_diagonal(shares, 0.0)
    unusual = [surprise(one.effect) for one in setting.unknown]
    needed = ENOUGH + NATS_OF_SURPRISE * np.array(unusual)
    sizes = smallest_sizes(setting, knots, nats, needed)
    found = []
    words = [
        effect_words(further.resized(size).effect, names) for further, size in zip(setting.unknown, sizes, strict=True)
    ]
    for index in sorted(range(len(nats)), key=lambda one: (unusual[one], -nats[one])):
        is_shown, other = bool(nats[index] >= needed[index]), int(shares[index].argmax())
        alike = words[other] if is_shown and shares[index, other] > ALIKE else None
        found.append(Shown(words[index], is_shown, float(nats[index]), alike))
    return tuple(found)


def smallest_sizes(setting: Setting, knots: np.ndarray, nats: np.ndarray, needed: np.ndarray) -> np.ndarray:
    """The smallest size of each unknown effect that would show, as a share of its usual size, (E); 1 for none.

    Changes grow with the size, but not in proportion: friction that stops a joint cannot stop it more. So the size at
    which they suffice is approached in a few steps, each as if they were in proportion.

    Args:
        setting: what the experiment is for.
        knots: knots of the commands.
        nats: expected log likelihood ratios for the usual sizes, (E).
        needed: log likelihood ratios from which they show, (E).
    """
    sizes = np.ones(len(nats))
    for _ in range(APPROACHES):
        sizes = np.minimum(sizes * np.sqrt(needed / nats), 1.0)
        smaller = [one.resized(size) for one, size in zip(setting.unknown, sizes, strict=True)]
        nats = np.maximum(replace(setting, unknown=smaller).overlaps(knots).diagonal(), 1e-12)
    return sizes
