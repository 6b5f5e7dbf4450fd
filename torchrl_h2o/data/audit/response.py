"""Simulated windows of a log, and what small changes of actions, forces and states do to their last velocities."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from torchrl_h2o.data.audit.log import AuditedSimulation, Log, Pair

WINDOWS = 500  # windows that are simulated at most
MIN_WINDOWS = 60  # windows below which the model is not consulted
PHYSICS_STEPS = 4_000  # physics steps of one pass over the windows at most
LONGEST_STEPS = 200  # physics steps of a window up to which MIN_WINDOWS are simulated in any case
HYPOTHESIS_WINDOWS = 200  # windows on which a hypothesis such as exchanged joints is simulated at most
HYPOTHESIS_STEPS = 1_000  # physics steps of one hypothesis at most
LONGEST_WINDOW = 0.1  # s
# change of the velocities within a window, in standard deviations of their noise: long windows show small causes, and
# short ones what acts at once, such as actions and dry friction
LONG, SHORT = 10.0, 4.0
LOST = 1.0  # rad; noise of an angle above which it does not tell where a joint is
DROWNED = 0.6  # noise of a change, in usual changes, above which a bad fit is no evidence against the data
SETTLING_STEPS = 12  # control steps from which unobserved coordinates are simulated
NUDGE = 0.02  # step of derivatives, in ranges or spreads of an action
ZERO_NUDGE = 0.02  # step of derivatives by the zero of a position, in rad or m


@dataclass(frozen=True, eq=False)
class Response:
    """Windows of measured rows and their simulation.

    Args:
        log: the data.
        simulation: the simulator.
        horizon: control steps per window, H.
        starts: first row of each window, (W,).
        states: start states, (W, nq + nv).
        actions: executed actions of all rows, (T, nu).
        activations: activations of the actuators before each row, (T, na).
        moving: columns of the observed velocities, (m,).
        noise: standard deviation of the noise of each observation, (n,); None if it is not known.
        like: similar windows, whose derivatives are taken for those of these windows; None to compute them.
        is_known: whether the simulator is that of the user, without rotors of a size that was tried.
    """

    log: Log
    simulation: AuditedSimulation
    horizon: int
    starts: np.ndarray
    states: np.ndarray
    actions: np.ndarray
    activations: np.ndarray
    moving: np.ndarray
    noise: np.ndarray | None = None
    like: Response | None = None
    is_known: bool = True

    @classmethod
    def of(
        cls, log: Log, simulation: AuditedSimulation, noise: np.ndarray | None, signal: float = LONG
    ) -> Response | None:
        """Chooses windows in which the velocities change by more than their noise; None without enough of them.

        Args:
            log: the data.
            simulation: the simulator.
            noise: standard deviation of the noise of each observation, (n,); None for windows of one step.
            signal: change of the velocities within a window, in standard deviations of their noise.
        """
        moving = np.array([velocity.column for velocity in log.velocities], int)
        if not len(moving):
            return None
        horizon = 1 if noise is None else _horizon(log, moving, noise, signal)
        margin = SETTLING_STEPS if simulation.state_map.hidden else 0
        length = simulation.frame_skip * horizon
        fewest = MIN_WINDOWS if length <= LONGEST_STEPS else 0
        most = min(WINDOWS, max(fewest, PHYSICS_STEPS // length))
        starts = log.starts(horizon, most, margin, log.touching)
        if len(starts) < MIN_WINDOWS:
            return None
        actions = np.concatenate([simulation.executed(log.action[run]) for run in log.runs])
        activations = _activations(log, simulation, actions)
        true = np.concatenate([simulation.true_observations(log.observation[run]) for run in log.runs])
        states = simulation.state_map.states(true)
        chosen = states[starts]
        if margin:  # unobserved coordinates are simulated over the steps before, with the others measured
            before = starts + np.arange(-margin, 0)[:, None]
            time = simulation.control_step * before if log.time is None else log.time[before]
            after, _ = simulation.follow(states[before], actions[before], time, activations[before])
            chosen[:, list(simulation.state_map.hidden)] = after[-1]
        return cls(log, simulation, horizon, starts, chosen, actions, activations, moving, noise)

    @property
    def rows(self) -> np.ndarray:
        """Rows of each window, (W, H)."""
        return self.starts[:, None] + np.arange(self.horizon)

    def thinned(self, most: int) -> Response:
        """At most ``most`` of the windows, evenly spread."""
        return self.at(np.unique(np.linspace(0, len(self.starts) - 1, min(most, len(self.starts))).round().astype(int)))

    def at(self, windows: np.ndarray) -> Response:
        """Some of the windows: indices or a mask."""
        return replace(self, starts=self.starts[windows], states=self.states[windows])

    @cached_property
    def short(self) -> Response:
        """Short windows, which show what acts at once."""
        short = Response.of(self.log, self.simulation, self.noise, SHORT) or self
        return replace(short, is_known=self.is_known)

    def for_hypotheses(self) -> Response:
        """As many of the short windows as a hypothesis may simulate."""
        most = HYPOTHESIS_STEPS // (self.simulation.frame_skip * self.short.horizon)
        return self.short.thinned(int(np.clip(most, MIN_WINDOWS, HYPOTHESIS_WINDOWS)))

    def changed(self, change: Callable[[np.ndarray], np.ndarray]) -> Response:
        """The same windows with changed observations (..., n), and with the derivatives of these windows."""
        observation, following = change(self.log.observation), change(self.log.following)
        moved = observation[self.starts] - self.log.observation[self.starts]
        states = self.states + moved @ self.simulation.state_map.restore.T
        return replace(
            self, log=replace(self.log, observation=observation, following=following), states=states, like=self
        )

    def driven_by(self, actions: np.ndarray) -> Response:
        """The same windows with other executed actions, (T, nu), and with the derivatives of these windows."""
        activations = _activations(self.log, self.simulation, actions)
        return replace(self, actions=actions, activations=activations, like=self)

    def shifted(self, shifts: np.ndarray, windows: np.ndarray | None = None) -> Response:
        """The same windows with shifts of the positions of the pairs, (pairs,), in some windows, (W,), or in all."""
        states = self.states.copy()
        moved = np.broadcast_to(shifts, (len(states), len(shifts)))
        states[:, [pair.coordinate for pair in self.log.pairs]] += (
            moved if windows is None else moved * windows[:, None]
        )
        return replace(self, states=states, like=self)

    @property
    def before(self) -> np.ndarray:
        """Measured velocities at the start of each window, (W, m)."""
        return self.log.observation[self.starts][:, self.moving]

    @cached_property
    def change(self) -> np.ndarray:
        """Measured change of the velocities within each window, (W, m)."""
        return self.log.following[self.starts + self.horizon - 1][:, self.moving] - self.before

    @cached_property
    def scale(self) -> np.ndarray:
        """Usual change of each velocity, (m,)."""
        usual = np.median(np.abs(self.change), axis=0)
        return np.where(usual > 0.0, usual, np.maximum(np.abs(self.change).mean(0), 1e-12))

    @property
    def lost(self) -> list[Pair]:
        """Angles whose noise is so large that they do not tell where the joint is."""
        return [pair for pair in self.log.pairs if pair.angle and self.noise_of(pair) > LOST]

    def noise_of(self, pair: Pair) -> float:
        """Standard deviation of the noise of a position; 0 if it is not known."""
        return 0.0 if self.noise is None else float(self.noise[pair.position])

    @property
    def drowned(self) -> bool:
        """Whether noise alone would leave most velocities unexplained."""
        if self.noise is None:
            return False
        share = np.sqrt(2.0) * self.noise[self.moving] / self.scale
        return bool(np.median(share) > DROWNED)

    @cached_property
    def limited(self) -> np.ndarray:
        """Executed actions within the actuators' range, (T, nu)."""
        return np.clip(self.actions, *self._range)

    @cached_property
    def anchor(self) -> np.ndarray:
        """Actions of the windows about which the simulation is linearised, (W, H, nu).

        The logged actions, or zero if they do not reduce the simulator's error: linearising about wrong actions adds an
        error correlated with them.
        """
        if self.like is not None and self.like.actions is self.actions:
            return self.like.anchor
        logged = self.limited[self.rows]
        without = self.misfit(actions=np.zeros_like)
        return logged if without > self.misfit() else np.zeros_like(logged)

    @cached_property
    def _range(self) -> tuple[np.ndarray, np.ndarray]:
        model = self.simulation.model
        low, high = model.actuator_ctrlrange.T
        free = model.actuator_ctrllimited == 0
        return np.where(free, -np.inf, low), np.where(free, np.inf, high)

    @cached_property
    def action_unit(self) -> np.ndarray:
        """Half the range of each actuator, or twice the spread of its action without a range, (nu,)."""
        low, high = self._range
        spread = 2.0 * self.actions.std(0) + 1e-9
        return np.where(np.isfinite(high - low), 0.5 * (high - low), spread)

    def reached(
        self,
        states: np.ndarray,
        actions: np.ndarray,
        applied: np.ndarray | None = None,
        simulation: AuditedSimulation | None = None,
    ) -> np.ndarray:
        """Simulated observations at the end of windows, (B, n), from states (B, nq + nv) and actions (B, H, nu).

        The states are those of all windows, once or several times.
        """
        chosen = self.simulation if simulation is None else simulation
        activations = self.activations[self.starts]
        activations = np.tile(activations, (len(states) // len(self.starts), 1))
        end = chosen.rollout(states, actions, activations=activations, applied=applied)[:, -1]
        return self.simulation.state_map.observations(end)

    @cached_property
    def simulated(self) -> np.ndarray:
        """Simulated change of the velocities under the actions of :attr:`anchor`, (W, m)."""
        return self.reached(self.states, self.anchor)[:, self.moving] - self.before

    @cached_property
    def target(self) -> np.ndarray:
        """Change of the velocities that the actions have to explain, linearised, (W, m)."""
        effect = (self.by_action * self.anchor.mean(1)[:, None]).sum(-1)
        return self.change - self.simulated + effect

    @cached_property
    def error(self) -> np.ndarray:
        """Measured minus simulated observation at the end of each window, (W, n)."""
        last = self.log.following[self.starts + self.horizon - 1]
        return last - self.reached(self.states, self.limited[self.rows])

    def _moved(self, states: np.ndarray, actions: np.ndarray, applied: np.ndarray | None = None) -> np.ndarray:
        """What K variants of all windows change in their velocities, from states (K W, nq + nv), (W, m, K)."""
        reached = self.reached(states, actions, applied)[:, self.moving].reshape(-1, *self.change.shape)
        return np.moveaxis(reached - self.before - self.simulated, 0, -1)

    @cached_property
    def by_action(self) -> np.ndarray:
        """Derivative of the change by a constant offset of each action, (W, m, nu), by differences inside its range."""
        if self.like is not None:
            return self.like.by_action
        base, number = self.anchor, self.anchor.shape[-1]
        if not number:  # a model without actuators
            return np.zeros((*self.change.shape, 0))
        inward = np.where(base.mean(1) > 0.5 * sum(np.nan_to_num(self._range, posinf=0.0, neginf=0.0)), -1.0, 1.0)
        steps = inward * NUDGE * self.action_unit  # (W, nu)
        actions = np.concatenate([base + (steps * row)[:, None] for row in np.eye(number)])
        return self._moved(np.tile(self.states, (number, 1)), actions) / steps[:, None]

    @cached_property
    def by_gain(self) -> np.ndarray:
        """Derivative of the change by the gain of each action, (W, m, nu)."""
        return self.by_action * self.limited[self.rows].mean(1)[:, None]

    @cached_property
    def by_force(self) -> np.ndarray:
        """Derivative of the change by a constant force on each velocity's degree of freedom, (W, m, m)."""
        if self.like is not None:
            return self.like.by_force
        dofs, model = [velocity.dof for velocity in self.log.velocities], self.simulation.model
        inertia = 1.0 / np.maximum(model.dof_invweight0[dofs], 1e-9)  # diagonal
        size = np.maximum(NUDGE * inertia * self.scale / (self.horizon * self.log.dt), 1e-9)
        applied = np.zeros((len(dofs), len(self.starts), self.horizon, model.nv))
        for index, dof in enumerate(dofs):
            applied[index, ..., dof] = size[index]
        states, actions = np.tile(self.states, (len(dofs), 1)), np.tile(self.anchor, (len(dofs), 1, 1))
        return self._moved(states, actions, applied.reshape(-1, *applied.shape[2:])) / size

    @cached_property
    def by_zero(self) -> np.ndarray:
        """Derivative of the change by the zero of each pair's position, (W, m, pairs)."""
        if self.like is not None:
            return self.like.by_zero
        pairs = self.log.pairs
        if not pairs:  # of wheels, whose speed alone is measured
            return np.zeros((*self.change.shape, 0))
        states = np.tile(self.states, (len(pairs), 1, 1))
        for index, pair in enumerate(pairs):
            states[index, :, pair.coordinate] += ZERO_NUDGE
        actions = np.tile(self.anchor, (len(pairs), 1, 1))
        return self._moved(states.reshape(-1, states.shape[-1]), actions) / ZERO_NUDGE

    def mean_action(self, lag: int) -> tuple[np.ndarray, np.ndarray]:
        """Mean action of each window if actions act ``lag`` rows late, (W, nu), and which windows have it, (W,)."""
        sums = np.concatenate([np.zeros((1, self.actions.shape[1])), np.cumsum(self.limited, axis=0)])
        first = self.starts - lag
        inside = np.clip(first, 0, len(self.log) - self.horizon)
        known = (first == inside) & (self.log.run[inside] == self.log.run[self.starts])
        known &= self.log.run[inside + self.horizon - 1] == self.log.run[self.starts]
        return (sums[inside + self.horizon] - sums[inside]) / self.horizon, known

    def misfit(self, actions: Callable[[np.ndarray], np.ndarray] | None = None) -> float:
        """Unexplained share of the change of the velocities: median error over median change, mean over velocities.

        Args:
            actions: changes the actions (W, H, nu) first, also to another number of steps; None for none.
        """
        executed = self.limited[self.rows]
        if actions is not None:
            executed = np.clip(actions(executed), *self._range)
        error = np.abs(self.change - (self.reached(self.states, executed)[:, self.moving] - self.before))
        error = np.where(np.isfinite(error), error, np.inf)
        usual = np.median(np.abs(self.change), axis=0)
        share = np.median(error, axis=0) / np.where(usual > 0.0, usual, np.inf)
        return float(np.minimum(share, 3.0).mean())


def _activations(log: Log, simulation: AuditedSimulation, actions: np.ndarray) -> np.ndarray:
    """Activations of the actuators before each row, (T, na), if each run begins without any."""
    return np.concatenate([simulation.activations(actions[run]) for run in log.runs])


def _horizon(log: Log, moving: np.ndarray, noise: np.ndarray, signal: float) -> int:
    """Shortest window in which the median velocity changes by a multiple of its noise."""
    longest = max(1, int(LONGEST_WINDOW / log.dt))
    horizon = 1
    while horizon < longest:
        starts = log.starts(horizon, 2000)
        if not len(starts):
            break
        change = (log.following[starts + horizon - 1] - log.observation[starts])[:, moving]
        usual = np.median(np.abs(change), axis=0)
        if np.median(usual / np.maximum(noise[moving], 1e-12)) >= signal:
            break
        horizon = min(2 * horizon, longest)
    return horizon
