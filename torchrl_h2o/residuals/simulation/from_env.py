"""A TorchRL env as a simulation that tracing can step."""

import numpy as np
from torchrl.envs import EnvBase

from torchrl_h2o.envs.backends.gymnasium import GymnasiumSimulator
from torchrl_h2o.envs.mujoco_model import find_simulator
from torchrl_h2o.residuals.simulation.observability import with_hidden_states
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.simulation.state_map import probe_gymnasium


def simulation_of(env: EnvBase) -> Simulation:
    """The simulation inside an env of a Gymnasium MuJoCo task, with its gaps; see :meth:`Simulation.from_env`."""
    simulator = find_simulator(env)
    if not isinstance(simulator, GymnasiumSimulator):
        raise ValueError(
            f"{env} is no Gymnasium task, and how its observation is made of the state is not known; take "
            "Simulation.from_mjcf with a StateMap"
        )
    task = simulator.owner
    applied = getattr(task, "_dynamics_gaps", {})
    simulation = Simulation(
        spec=simulator.spec,
        frame_skip=round(simulator.control_step / simulator.model.opt.timestep),
        state_map=probe_gymnasium(task, np.random.default_rng(0)),
        effects=tuple(effect for effects in applied.values() for effect in effects),
        name=task.spec.id if task.spec is not None else type(task).__name__,
    )
    return with_hidden_states(simulation)
