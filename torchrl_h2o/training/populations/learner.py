"""One update of many runs together: batches, losses, one optimiser step, one update of all target networks."""

from collections.abc import Callable, Sequence
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from torchrl_h2o.data import PairedTransitions
from torchrl_h2o.objectives import total_loss
from torchrl_h2o.training.cuda_graph import as_cuda_graph
from torchrl_h2o.training.learner import Learner
from torchrl_h2o.training.populations.population import Population
from torchrl_h2o.training.populations.replay import PopulationReplay
from torchrl_h2o.training.warm_start import hold


class PopulationLearner:
    """The learners of N runs as one. A member is stopped when its losses or parameters are no longer finite.

    All members draw from torch's global generator, in a few calls.

    Args:
        learners: one per member. Their individual optimisers and target updaters are not used.
        replay: the members' data.
        lr: learning rate of Adam.
        tau: weight of the online networks in an update of the target networks.
        held: number of first updates in which the policies stay as they are.
    """

    def __init__(
        self, learners: Sequence[Learner], replay: PopulationReplay, lr: float, tau: float, held: int = 0
    ) -> None:
        self.learners, self.replay, self.tau, self.held = learners, replay, tau, held
        self.population = Population([cast(nn.Module, learner.terms_of) for learner in learners])  # H2O+'s are its loss
        self.losses_of: Callable[..., dict[str, Tensor]] = self.population  # may be compiled
        self.optimiser = torch.optim.Adam(self.population.parameters(), lr=lr, fused=True)
        self.updates = 0
        self.failures: dict[int, dict] = {}
        self._batches: list[TensorDictBase] = []
        self._halves: tuple[Callable, Callable] = self._differentiate, self._step

    def use_cuda_graphs(self) -> None:
        """Makes both halves of each update with a CUDA graph; needs ``fit_to_device`` before the first update."""
        differentiate, step = (as_cuda_graph(half, self.replay.device) for half in (self._differentiate, self._step))

        def with_present_lengths() -> Any:
            self.replay.find_lengths()  # a graph repeats how it draws, and cannot find that the buffers have grown
            return differentiate()

        self._halves = with_present_lengths, step

    def update(self) -> dict[str, Tensor]:
        """Make one update and return the terms by name, ``[N]`` each."""
        differentiate, step = self._halves
        terms, self._batches = differentiate()
        healthy = total_loss(terms).isfinite()
        if not healthy.all():
            self._note_failures(healthy, terms)
        for number in self.failures:
            self.population.stop(number, self.optimiser)
        if self.updates < self.held:
            hold(self.population.policies, self.optimiser)
        step()
        self.updates += 1
        return terms

    def _differentiate(self) -> tuple[dict[str, Tensor], list[TensorDictBase]]:
        """Make the first half of an update: compute losses and gradients. Return the terms and the batches."""
        batches = self.sample()
        terms = self.losses_of(*batches)
        # on a GPU the gradients stay in the same memory, where a graph of the step reads them
        self.optimiser.zero_grad(set_to_none=self.replay.device.type == "cpu")
        total_loss(terms).sum().backward()  # a member's loss depends on its own parameters only
        return {name: term.detach() for name, term in terms.items()}, batches

    def _step(self) -> None:
        """Make the second half of an update: the optimiser's step and the update of the target networks."""
        self.optimiser.step()
        self.population.move_targets(self.tau)

    def check_parameters(self) -> None:
        """Record members whose parameters are not finite as failed, without waiting for their next losses."""
        self._note_failures(self.population.finite(), {})

    def batches_of(self, number: int) -> list[TensorDictBase]:
        """Return a member's batches of the last update."""
        return [batch[number] for batch in self._batches]

    def _note_failures(self, healthy: Tensor, terms: dict[str, Tensor]) -> None:
        for number in (~healthy).nonzero().flatten().tolist():
            bad = [name for name, term in terms.items() if not term[number].isfinite()]
            why = f"{' and '.join(bad) or 'its parameters'} not finite"
            self.note_failure(number, why)

    def note_failure(self, number: int, why: str) -> None:
        """Stop a member, if it is not stopped already."""
        self.failures.setdefault(number, {"updates": self.updates, "why": why})

    def sample(self) -> list[TensorDictBase]:
        """Draw the batches of one update of all members, ``[N, B]`` each."""
        first, *second = self.learners[0].batch_sizes
        if self.learners[0].pairs is None:
            return [self.replay.sample(size) for size in (first, *second)]
        pairs = [cast(PairedTransitions, learner.pairs).sample(second[0]) for learner in self.learners]
        return [self.replay.sample(first), TensorDict.stack(pairs)]
