"""Many runs as one: stacked parameters, all losses computed in one call, one optimiser.

With small networks a device is idle between kernels. Stacking N networks replaces many small products by few large
ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams, is_tensor_collection
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode
from torchrl.objectives import LossModule

Stackable = TensorDictParams | Tensor


class Population(nn.Module):
    """The losses of N runs, evaluated together by ``torch.vmap`` over their stacked parameters and buffers.

    All tensors of the members are stacked: networks, target networks, β, λ, γ. These may differ between members. All
    other settings (layer widths, backbone, use of the ratio) are taken from the first member and must be equal in all.

    The members stay usable: their parameters become views of the stack. A member's policy therefore always uses the
    population's current parameters, and a checkpoint of the members is a checkpoint of the population. Move members to
    their device before they are stacked. Only the stack has gradients, so build the optimiser from the population's
    parameters.

    Each member draws random numbers of its own from torch's global generator (``randomness="different"`` of ``vmap``):
    other numbers than it would draw as a single run. So a member equals a single run in its statistics, not to the
    digit. Branches must not depend on data or parameters, and members must not differ in structure.

    Buffers that a forward changes, such as the running means of batch normalisation, are not written back.

    Args:
        members (sequence of nn.Module): one per run: a loss such as :class:`~torchrl_h2o.objectives.H2OPlusLoss` or
            TorchRL's ``SACLoss``, or a module with several losses. ``forward(*batches)`` returns the terms by name.

    Raises:
        ValueError: if there are no members, or their tensors differ in shape.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl_h2o.objectives import H2OPlusLoss, MixedBellmanLoss, make_actor, make_qvalue, total_loss
        >>> from torchrl_h2o.training.populations import Population
        >>> def make_loss(seed):
        ...     torch.manual_seed(seed)
        ...     actor = make_actor(observation_dim=3, action_spec=Bounded(-1, 1, (1,)))
        ...     return H2OPlusLoss(MixedBellmanLoss(actor, [make_qvalue(3, 1), make_qvalue(3, 1)], mixing=0.0))
        >>> population = Population([make_loss(seed) for seed in range(5)])
        >>> optimiser = torch.optim.Adam(population.parameters(), lr=3e-4, fused=True)
        >>> batch = TensorDict(observation=torch.randn(5, 8, 3), action=torch.rand(5, 8, 1),
        ...                    real=(torch.arange(8) < 4).expand(5, 8),
        ...                    next=TensorDict(observation=torch.randn(5, 8, 3), reward=torch.randn(5, 8, 1),
        ...                                    terminated=torch.zeros(5, 8, 1, dtype=torch.bool)), batch_size=[5, 8])
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
        self.members = tuple(members)  # a tuple, so that nn.Module does not register their parameters
        for member in members:
            member.state_dict()  # TorchRL's losses create some buffers at the first access
        own = [_tensors(member) for member in members]
        self._paths = list(own[0])
        for number, tensors in enumerate(own):
            _check_alike(number, tensors, own[0])
        stacked, stacks = TensorDict({}, batch_size=[len(members)]), {}
        for path in self._paths:
            stacked.set(path, _stack([tensors[path] for tensors in own], stacks))
        self.stacked = TensorDictParams(stacked, no_convert=True)
        for number, tensors in enumerate(own):
            for path, held in tensors.items():
                _look_into(held, self.stacked.get(path), number)
        self._own_numbers = _OwnNumbers()  # a compiled forward pass cannot create one

    def __len__(self) -> int:
        return len(self.members)

    def forward(self, *batches: TensorDictBase) -> dict[str, Tensor]:
        """Compute the terms of each member on the member's batches.

        Args:
            *batches: stacked inputs of the members' forward passes, ``[N, *B]``.

        Returns:
            The terms by name, ``[N]`` each; for losses with ``reduction="none"``, ``[N, *B]``.
        """
        return torch.vmap(self._terms_of_one, randomness="different")(self.stacked, *batches)

    def _terms_of_one(self, tensors: TensorDictBase, *batches: TensorDictBase) -> dict[str, Tensor]:
        own = {path: tensors.get(path) for path in self._paths}
        with _in_place_of_own(self.members[0], own) as member, self._own_numbers:
            return dict(member(*batches).items())

    @torch.no_grad()
    def move_targets(self, tau: float) -> None:
        """Update the target networks of each member, as ``SoftUpdate(loss, tau=tau).step()`` does.

        Args:
            tau: weight of the online networks.
        """
        for path in self._paths:
            *owner, name = path
            if name.startswith("target_") and name.endswith("_params"):
                source = self.stacked.get((*owner, name.removeprefix("target_")))
                self.stacked.get(path).data.lerp_(source.data, 1.0 - (1.0 - tau))  # rounds like SoftUpdate

    @property
    def policies(self) -> list[Tensor]:
        """The stacked parameters of the members' policies, as the optimiser has them."""
        own = {id(parameter) for parameter in self.parameters()}
        paths = [path for path in self._paths if path[-1] == "actor_network_params"]
        stacks = [cast(TensorDictBase, self.stacked.get(path)) for path in paths]
        return [leaf for stack in stacks for leaf in stack.values(True, True) if id(leaf) in own]

    def finite(self) -> Tensor:
        """Whether all parameters of a member are finite, ``[N]``."""
        leaves = [leaf.detach().isfinite().reshape(len(self), -1).all(1) for leaf in self.parameters()]
        return torch.stack(leaves).all(0)

    @torch.no_grad()
    def stop(self, number: int, optimiser: torch.optim.Adam) -> None:
        """Zero a member's gradients and momentum, so that the optimiser's next step does not change the member.

        Call it before every step.

        Args:
            number: index of the member.
            optimiser: the population's optimiser, without weight decay.
        """
        for parameter in self.parameters():
            if parameter.grad is not None:
                parameter.grad[number] = 0.0
            momentum = optimiser.state[parameter].get("exp_avg")
            if momentum is not None:
                momentum[number] = 0.0


class _OwnNumbers(TorchFunctionMode):
    """Draws normal numbers out of place, because ``vmap`` refuses to fill one tensor for all members in place.

    ``torch.distributions`` fills a tensor in place.
    """

    def __torch_function__(self, func: Callable, types: tuple, args: tuple = (), kwargs: dict | None = None) -> Any:
        if func is torch.Tensor.normal_ and len(args) == 1 and not kwargs:
            return torch.randn_like(args[0])
        return func(*args, **({} if kwargs is None else kwargs))


def _tensors(member: nn.Module) -> dict[tuple[str, ...], Stackable]:
    """All tensors of a member, by every path to them; the tensors of one network stay in one tensordict."""
    tensors: dict[tuple[str, ...], Stackable] = {}
    for name, module in member.named_modules(remove_duplicate=False):  # a shared network has several paths
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


def _stack(held: list[Stackable], stacks: dict[int, Tensor]) -> TensorDictBase | Tensor:
    """Stack the same tensor or network of all members. Parameters stay parameters; a shared tensor gets one stack.

    Args:
        held: the tensor or network of each member.
        stacks: the stacks so far, by ``id`` of the first member's tensor.
    """

    def one(*tensors: Tensor) -> Tensor:
        if id(tensors[0]) not in stacks:
            stack = torch.stack([tensor.detach() for tensor in tensors])
            stacks[id(tensors[0])] = nn.Parameter(stack) if isinstance(tensors[0], nn.Parameter) else nn.Buffer(stack)
        return stacks[id(tensors[0])]

    if isinstance(held[0], Tensor):
        return one(*held)
    networks = cast(list[TensorDictBase], held)
    return TensorDict(
        {key: one(*(params.get(key) for params in networks)) for key in networks[0].keys(True, True)},
        batch_size=[len(networks), *networks[0].batch_size],
    )


def _look_into(held: Stackable, stack: TensorDictBase | Tensor, number: int) -> None:
    """Replace a member's tensors by views of the stack."""
    if not isinstance(held, TensorDictParams):
        held.data = stack.data[number]
        return
    params, stacked = cast(TensorDictBase, held), cast(TensorDictBase, stack)
    for key in params.keys(True, True):
        params.get(key).data = stacked.get(key).data[number]
    own = cast(TensorDictBase, held._param_td)
    nested = [cast(TensorDictBase, value) for value in own.values(True) if is_tensor_collection(value)]
    for part in (params, own, *nested):
        part._erase_cache()  # a locked tensordict caches values computed from its old tensors


@contextmanager
def _in_place_of_own(member: nn.Module, tensors: dict[tuple[str, ...], TensorDictBase | Tensor]) -> Iterator[nn.Module]:
    """Replace a member's tensors: an instance attribute hides the registered parameter or buffer of the same name."""
    owners = {path: member.get_submodule(".".join(path[:-1])) for path in tensors}
    for path, value in tensors.items():
        owners[path].__dict__[path[-1]] = value
    try:
        with _without_caches(member):
            yield member
    finally:
        for path, owner in owners.items():
            owner.__dict__.pop(path[-1], None)  # the module of a shared network may occur twice


@contextmanager
def _without_caches(member: nn.Module) -> Iterator[None]:
    """Clear the parameter caches of TorchRL's losses before and after the block, in which parameters are replaced."""
    cached: list[nn.Module] = [module for module in member.modules() if isinstance(module, LossModule)]
    for module in cached:
        module.__dict__["_cache"] = {}
    try:
        yield
    finally:
        for module in cached:
            module.__dict__["_cache"] = {}
