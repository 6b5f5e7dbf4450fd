"""One update of many runs at once: batches, losses, one optimiser step, one step of all targets."""

from collections.abc import Callable, Sequence
from typing import cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from torchrl_h2o.objectives import total_loss
from torchrl_h2o.training.learner import Learner
from torchrl_h2o.training.populations.population import Population
from torchrl_h2o.training.populations.replay import PopulationReplay


class PopulationLearner:
    """The learners of N runs as one; a member whose losses stop being finite is stopped.

    On a CPU each member draws from a random stream of its own, in the order in which a single run draws. On a GPU that
    would take a thousand small kernels per update, so there all draw from torch's global generator, in a few calls.

    Args:
        learners: one per member. Their own optimisers and target updaters stay unused.
        replay: the members' data.
        lr: of Adam.
        tau: of the target networks.
        capturable: whether a CUDA graph may capture the optimiser's step.
    """

    def __init__(
        self, learners: Sequence[Learner], replay: PopulationReplay, lr: float, tau: float, capturable: bool = False
    ) -> None:
        self.learners, self.replay, self.tau = learners, replay, tau
        self.population = Population([cast(nn.Module, learner.terms_of) for learner in learners])  # H2O+'s are its loss
        self.losses_of: Callable[..., dict[str, Tensor]] = self.population  # may be compiled
        self.optimiser = torch.optim.Adam(self.population.parameters(), lr=lr, fused=True, capturable=capturable)
        on_cpu = replay.device.type == "cpu"
        self.generators = [torch.Generator() for _ in learners] if on_cpu else None
        self.updates = 0
        self.failures: dict[int, dict] = {}
        self._batches: list[TensorDictBase] = []

    def start_stream(self, number: int) -> None:
        """Set a member's stream to the state of torch's global generator."""
        if self.generators is not None:
            self.generators[number].set_state(torch.get_rng_state())

    def update(self) -> dict[str, Tensor]:
        """Make one update and return each term of each member, ``[N]``."""
        terms = self.differentiate()
        healthy = total_loss(terms).isfinite()
        if not healthy.all():
            self._note_failures(healthy, terms)
        for number in self.failures:
            self.population.stop(number, self.optimiser)
        self.step()
        self.updates += 1
        return terms

    def differentiate(self) -> dict[str, Tensor]:
        """Make the first half of an update: losses and gradients."""
        self._batches = self.sample()
        noise = self.population.draw(*self._batches, generators=self.generators)
        terms = self.losses_of(*self._batches, noise=noise)
        self.optimiser.zero_grad()
        total_loss(terms).sum().backward()  # no member's loss depends on another's parameters
        return terms

    def step(self) -> None:
        """Make the second half of an update: the optimiser's step and the targets'."""
        self.optimiser.step()
        self.population.move_targets(self.tau)

    def check_parameters(self) -> None:
        """Stop members whose parameters are not finite, before their next losses show it."""
        self._note_failures(self.population.finite(), {})

    def batches_of(self, number: int) -> list[TensorDictBase]:
        """Return a member's batches of the last update."""
        return [batch[number] for batch in self._batches]

    def _note_failures(self, healthy: Tensor, terms: dict[str, Tensor]) -> None:
        for number in (~healthy).nonzero().flatten().tolist():
            bad = [name for name, term in terms.items() if not term[number].isfinite()]
            why = f"{' and '.join(bad) or 'its parameters'} not finite"
            self.failures.setdefault(number, {"updates": self.updates, "why": why})

    def sample(self) -> list[TensorDictBase]:
        """Draw the batches of one update of all members, ``[N, B]`` each."""
        return [self.replay.sample(size, self.generators) for size in self.learners[0].batch_sizes]
