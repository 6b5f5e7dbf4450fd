"""Tolerances and limits for building and stepping a simulation, as one documented settings object."""

from dataclasses import dataclass


@dataclass(frozen=True)
class SimulationSettings:
    """Tolerances and limits of a :class:`~torchrl_h2o.residuals.Simulation`.

    Args:
        rollout_numbers: largest number of float64 values that one call of ``mujoco.rollout`` returns; larger rollouts
            are split. The default is 128 MB.
        clock_jump: share of the control step by which the simulated time may differ from the expected one. MuJoCo
            resets a diverging simulation and its clock, so a larger difference marks divergence.
        clock_tolerance: share of the control step by which a recording's control step may differ from a multiple of
            the model's timestep.
        probe_spread: standard deviation of the random states that probe the observation and the hidden state, in m,
            rad, m/s or rad/s.
        spare_probes: number of probe states beyond those that determine a linear map; they test its linearity.
        linear_tolerance: largest error of the linear map on the probes, in units of the observation; smaller
            coefficients of the map are set to zero.
        far_state: magnitude of the coordinates at which the clipping of the observation is read, in m, rad, m/s or
            rad/s.
        nudge: displacement of an unobserved coordinate in the test for hidden state, in m, rad, m/s or rad/s.
        nudge_response: smallest change of the next observation that makes a nudged coordinate hidden state, in units
            of the observation.
        num_nudged: number of states at which an unobserved coordinate is nudged.
    """

    rollout_numbers: int = 2**24
    clock_jump: float = 0.5
    clock_tolerance: float = 0.01
    probe_spread: float = 0.01
    spare_probes: int = 4
    linear_tolerance: float = 1e-5
    far_state: float = 1e3
    nudge: float = 0.05
    nudge_response: float = 1e-6
    num_nudged: int = 8


SIMULATION_SETTINGS = SimulationSettings()
