"""One update of many runs at once: batches, losses, a step of one optimiser for all, a step of all targets."""

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_h2o.objectives import total_loss
from torchrl_h2o.training.learner import Learner
from torchrl_h2o.training.populations.population import Population
from torchrl_h2o.training.populations.replay import PopulationReplay


class PopulationLearner:
    """The learners of N runs as one; a member whose losses are no finite numbers any more stops.

    On a CPU each member draws from a random stream of its own, in the order in which a single run draws. On a GPU that
    would be a thousand small kernels an update, so there all draw from torch's global generator, in a few calls.

    Args:
        learners: one a member. Their own optimisers and target updaters stay unused.
        replay: the members' data.
        lr: of Adam.
        tau: of the target networks.
        capturable: whether a CUDA graph may capture the optimiser's step.
    """

    def __init__(
        self, learners: Sequence[Learner], replay: PopulationReplay, lr: float, tau: float, capturable: bool = False
    ) -> None:
        self.learners, self.replay, self.tau = learners, replay, tau
        self.population = Population([learner.terms_of for learner in learners])
        self.losses_of = self.population  # may be compiled
        self.optimiser = torch.optim.Adam(self.population.parameters(), lr=lr, fused=True, capturable=capturable)
        on_cpu = replay.device.type == "cpu"
        self.generators = [torch.Generator() for _ in learners] if on_cpu else None
        self.updates = 0
        self.failures: dict[int, dict] = {}
        self._batches: list[TensorDictBase] = []

    def start_stream(self, number: int) -> None:
        """Lets a member draw on from where torch's global generator is."""
        if self.generators is not None:
            self.generators[number].set_state(torch.get_rng_state())

    def update(self) -> dict[str, Tensor]:
        """One update; returns each term of each member, ``[N]``."""
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
        """The first half of an update: what the losses are, and their gradients."""
        self._draw()
        terms = self.losses_of(*self._batches)
        self.optimiser.zero_grad()
        total_loss(terms).sum().backward()  # no member's loss depends on another's parameters
        return terms

    def step(self) -> None:
        """The second half."""
        self.optimiser.step()
        self.population.move_targets(self.tau)

    def check_parameters(self) -> None:
        """Stops members whose parameters are no finite numbers any more, which their next losses would show."""
        self._note_failures(self.population.finite(), {})

    def batches_of(self, number: int) -> list[TensorDictBase]:
        """A member's batches of the last update."""
        return [batch[number] for batch in self._batches]

    def _note_failures(self, healthy: Tensor, terms: dict[str, Tensor]) -> None:
        for number in (~healthy).nonzero().flatten().tolist():
            bad = [name for name, term in terms.items() if not term[number].isfinite()]
            why = f"{' and '.join(bad) or 'its parameters'} not finite"
            self.failures.setdefault(number, {"updates": self.updates, "why": why})

    def sample(self) -> list[TensorDictBase]:
        """The batches of one update of all members, ``[N, B]`` each."""
        return [self.replay.sample(size, self.generators) for size in self.learners[0].batch_sizes]

    def _draw(self) -> None:
        """The members' batches, ``[N, B]``, with the noise of a forward on them."""
        self._batches = self.sample()
        if self.generators is None:
            noise = self.learners[0].terms_of.draw_noise(*self._batches)
        else:
            of_each = [
                learner.terms_of.draw_noise(*self.batches_of(number), generator=self.generators[number])
                for number, learner in enumerate(self.learners)
            ]
            noise = [torch.stack(same) for same in zip(*of_each, strict=True)]
        for batch, of_batch in zip(self._batches, noise, strict=True):
            batch["noise"] = of_batch
