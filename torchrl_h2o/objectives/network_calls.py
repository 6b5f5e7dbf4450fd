"""Call networks whose parameters are stored outside of them, as in TorchRL's losses."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch.distributions import Distribution
from torchrl.objectives.utils import _vmap_func


class NetworkCalls:
    """Calls networks as TorchRL does: puts the parameters into the module for one call, with ``vmap`` for an ensemble.

    Each loss has an instance as its attribute ``calls``. :func:`~torchrl_h2o.objectives.accelerate` replaces it.
    """

    def outputs(
        self,
        network: TensorDictModuleBase,
        tensordict: TensorDictBase,
        params: TensorDictBase,
        randomness: str = "error",
        *,
        frozen: bool = False,
    ) -> TensorDictBase:
        """Run a network with the given parameters.

        Args:
            network: the module. The parameters it holds are not used.
            tensordict: inputs, ``[*B]``. Other entries are ignored.
            params: parameters of one network, ``[]``, or of an ensemble, ``[N]``.
            randomness: ``vmap``'s setting for an ensemble whose networks draw random numbers.
            frozen: treat the parameters as constants, so that gradients reach the inputs only.

        Returns:
            A tensordict with the network's ``out_keys``, ``[*B]`` or ``[N, *B]``.
        """
        inputs, params = tensordict.select(*network.in_keys), params.detach() if frozen else params
        if params.ndim:
            vmapped = cast("Callable[..., TensorDictBase]", _vmap_func(network, (None, 0), randomness=randomness))
            return vmapped(inputs, params)
        with params.to_module(network, preserve_module_state=False):
            return network(inputs)

    def distribution(
        self, network: ProbabilisticTensorDictSequential, tensordict: TensorDictBase, params: TensorDictBase
    ) -> Distribution:
        """Return a policy's action distribution with the given parameters.

        Args:
            network: the policy.
            tensordict: inputs, ``[*B]``.
            params: parameters, ``[]``.
        """
        with params.to_module(network, preserve_module_state=False):
            return network.get_dist(tensordict.select(*network.in_keys))
