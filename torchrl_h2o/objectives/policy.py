"""What the losses need to know of a policy: its action's key and size, and that it has a density."""

from __future__ import annotations

from tensordict import NestedKey
from tensordict.nn import CompositeDistribution, ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential
from torchrl.data import Composite
from torchrl.modules import Delta, TanhDelta


def action_key_of(actor_network: ProbabilisticTensorDictSequential) -> NestedKey:
    """The key under which the actor writes its action."""
    keys = getattr(actor_network, "dist_sample_keys", None)
    return keys[0] if keys else "action"


def action_dim_of(actor_network: ProbabilisticTensorDictSequential, action_key: NestedKey) -> int | None:
    """Size of one agent's action from the actor's spec; None without a spec."""
    spec = getattr(actor_network, "spec", None)
    if not isinstance(spec, Composite):
        return None if spec is None else spec.shape.numel()
    leaf = spec.get(action_key, None)
    if leaf is None:
        return None
    # ProbabilisticActor drops the shape of a group of agents, so of a nested action only the last dimension counts.
    nested = isinstance(action_key, tuple) and len(action_key) > 1
    return leaf.shape[-1] if nested else leaf.shape[spec.ndim :].numel()


def check_policy(actor_network: ProbabilisticTensorDictSequential) -> None:
    """Raise a ValueError for a policy without reparameterised samples that have a density."""
    modules = [module for module in actor_network.modules() if isinstance(module, ProbabilisticTensorDictModule)]
    family = modules[-1].distribution_class if modules else None
    fits = family is not None
    if isinstance(family, type):  # a function that makes the distribution is not checked
        refused = (Delta, TanhDelta, CompositeDistribution)
        discrete = getattr(family, "has_enumerate_support", False) is True
        fits = not (issubclass(family, refused) or discrete or getattr(family, "has_rsample", True) is False)
    if not fits:
        name = "no distribution" if family is None else family.__name__
        raise ValueError(
            f"the policy has {name}, and these losses need one continuous action with reparameterised samples and a "
            "density, such as TanhNormal. For discrete or deterministic policies weight a loss of TorchRL by the "
            "dynamics ratio: ImportanceWeightedLoss(DiscreteSACLoss(..., reduction='none')), or TD3Loss."
        )
