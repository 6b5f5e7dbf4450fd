"""Many runs as one: their losses' parameters stacked, all losses taken in one call, one optimiser for all.

Small networks leave a device idle between kernels. N of them, stacked, are a few large products instead.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from torch import Tensor, nn

Stackable = TensorDictParams | Tensor


class Population(nn.Module):
    """The losses of N runs, evaluated together by ``torch.vmap`` over their stacked parameters and buffers.

    What is stacked is every tensor of a member: networks, targets, β, λ, γ. So these may differ between members. All
    else (widths, backbone, whether there is a ratio) is taken from the first, and must be the same in all.

    The members stay in use: their own parameters become views of the stack, so that a member's policy always acts with
    what the population has learnt, and a checkpoint of the members is one of the population. Put them on their device
    before. Gradients are the stack's alone, so the optimiser is built of the population's parameters.

    Args:
        members (sequence of nn.Module): one a run, a loss such as :class:`~torchrl_h2o.objectives.H2OPlusLoss` or a
            module that holds several; ``forward(*batches)`` returns the terms by name.

    Raises:
        ValueError: for no members, or members of unequal shapes.

    A loss that draws random numbers must be given them, as each member draws from a stream of its own: see
    :meth:`~torchrl_h2o.objectives.hybrid_loss.HybridLoss.draw_noise`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl_h2o.objectives import H2OPlusLoss, make_actor, make_qvalue, total_loss
        >>> from torchrl_h2o.training.populations import Population
        >>> def make_loss(seed):
        ...     torch.manual_seed(seed)
        ...     actor = make_actor(observation_dim=3, action_spec=Bounded(-1, 1, (1,)))
        ...     return H2OPlusLoss(actor, [make_qvalue(3, 1), make_qvalue(3, 1)], None, mixing=0.0)
        >>> population = Population([make_loss(seed) for seed in range(5)])
        >>> optimiser = torch.optim.Adam(population.parameters(), lr=3e-4, fused=True)
        >>> batch = TensorDict(observation=torch.randn(5, 8, 3), action=torch.rand(5, 8, 1),
        ...                    real=(torch.arange(8) < 4).expand(5, 8),
        ...                    next=TensorDict(observation=torch.randn(5, 8, 3), reward=torch.randn(5, 8, 1),
        ...                                    terminated=torch.zeros(5, 8, 1, dtype=torch.bool)), batch_size=[5, 8])
        >>> batch["noise"] = population.members[0].draw_noise(batch)  # or each member's own
        >>> terms = population(batch)
        >>> terms["loss_qvalue"].shape
        torch.Size([5])
        >>> total_loss(terms).sum().backward()
        >>> optimiser.step()
        >>> population.move_targets(tau=0.005)
    """

    def __init__(self, members: Sequence[nn.Module]) -> None:
        super().__init__()
        if not members:
            raise ValueError("a population needs at least one member.")
        self.members = tuple(members)  # a tuple, so that their parameters do not count twice
        self._paths = list(_tensors(members[0]))
        own = [_tensors(member) for member in members]
        for number, tensors in enumerate(own):
            _check_alike(number, tensors, own[0])
        stacked = TensorDict({}, batch_size=[len(members)])
        for path in self._paths:
            stacked.set(path, _stack([tensors[path] for tensors in own]))
        self.stacked = TensorDictParams(stacked, no_convert=True)
        for number, tensors in enumerate(own):
            for path, held in tensors.items():
                _look_into(held, self.stacked.get(path), number)

    def __len__(self) -> int:
        return len(self.members)

    def forward(self, *batches: TensorDictBase) -> dict[str, Tensor]:
        """Every member's terms on its own batches.

        Args:
            *batches: what a member's forward takes, stacked, ``[N, *B]``.

        Returns:
            What a member's forward returns, ``[N]`` or, of losses with ``reduction="none"``, ``[N, *B]``.
        """
        return torch.vmap(self._terms_of_one)(self.stacked, *batches)

    def _terms_of_one(self, tensors: TensorDictBase, *batches: TensorDictBase) -> dict[str, Tensor]:
        with _in_place_of_own(self.members[0], {path: tensors.get(path) for path in self._paths}) as member:
            return dict(member(*batches).items())

    @torch.no_grad()
    def move_targets(self, tau: float) -> None:
        """Each member's target networks, as ``SoftUpdate(loss, tau=tau).step()`` moves them.

        Args:
            tau: how much of the online networks goes into the targets.
        """
        for path in self._paths:
            *owner, name = path
            if name.startswith("target_") and name.endswith("_params"):
                source = self.stacked.get((*owner, name.removeprefix("target_")))
                self.stacked.get(path).data.lerp_(source.data, 1.0 - (1.0 - tau))  # SoftUpdate's own rounding

    def finite(self) -> Tensor:
        """Whether all of a member's parameters are finite numbers, ``[N]``."""
        leaves = [leaf.detach().isfinite().reshape(len(self), -1).all(1) for leaf in self.parameters()]
        return torch.stack(leaves).all(0)

    @torch.no_grad()
    def stop(self, number: int, optimiser: torch.optim.Adam) -> None:
        """Lets the coming step of the optimiser leave a member exactly as it is. To be called before each such step.

        Args:
            number: the member's.
            optimiser: that of the population, without weight decay.
        """
        for parameter in self.parameters():
            if parameter.grad is not None:
                parameter.grad[number] = 0.0
            momentum = optimiser.state[parameter].get("exp_avg")
            if momentum is not None:
                momentum[number] = 0.0


def _tensors(member: nn.Module) -> dict[tuple[str, ...], Stackable]:
    """Every tensor that a member holds, by the path to it; those of a network stay together."""
    tensors: dict[tuple[str, ...], Stackable] = {}
    for name, module in member.named_modules():
        path = tuple(name.split(".")) if name else ()
        if isinstance(module, TensorDictParams):
            tensors[path] = module
        else:
            own = {**dict(module.named_parameters(recurse=False)), **dict(module.named_buffers(recurse=False))}
            tensors |= {(*path, key): tensor for key, tensor in own.items()}
    return tensors


def _check_alike(number: int, tensors: dict, first: dict) -> None:
    def shapes(held: Stackable) -> dict | torch.Size:
        return held.shape if isinstance(held, Tensor) else {key: v.shape for key, v in held.items(True, True)}

    for path in {**first, **tensors}:
        if path not in tensors or path not in first or shapes(tensors[path]) != shapes(first[path]):
            raise ValueError(
                f"member {number} and member 0 of a population differ in {'.'.join(path)}: build all alike, with "
                "networks of the same sizes."
            )


def _stack(held: list[Stackable]) -> TensorDictBase | Tensor:
    """One stack of the members' tensors, each a leaf of its own: what is a parameter stays one."""

    def one(*tensors: Tensor) -> Tensor:
        stack = torch.stack([tensor.detach() for tensor in tensors])
        return nn.Parameter(stack) if isinstance(tensors[0], nn.Parameter) else nn.Buffer(stack)

    if isinstance(held[0], Tensor):
        return one(*held)
    return TensorDict(
        {key: one(*(params.get(key) for params in held)) for key in held[0].keys(True, True)},
        batch_size=[len(held), *held[0].batch_size],
    )


def _look_into(held: Stackable, stack: TensorDictBase | Tensor, number: int) -> None:
    """Makes a member's own tensors views of the stack."""
    if isinstance(held, Tensor):
        held.data = stack.data[number]
        return
    held.unlock_()  # while it is locked, a tensordict keeps at hand what it made of its old tensors
    for key in held.keys(True, True):
        held.get(key).data = stack.get(key).data[number]
    held.lock_()


@contextmanager
def _in_place_of_own(member: nn.Module, tensors: dict[tuple[str, ...], TensorDictBase | Tensor]) -> Iterator[nn.Module]:
    """The member with other tensors than its own: an attribute of the instance hides the one that is registered."""
    owners = {path: member.get_submodule(".".join(path[:-1])) for path in tensors}
    for path, value in tensors.items():
        owners[path].__dict__[path[-1]] = value
    try:
        yield member
    finally:
        for path, owner in owners.items():
            del owner.__dict__[path[-1]]
