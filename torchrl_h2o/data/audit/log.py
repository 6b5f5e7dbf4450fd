"""The data of an audit as float64 arrays, with the pairs of a joint's position and velocity among its columns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, cast

import numpy as np
import torch
from tensordict import TensorDictBase

from torchrl_h2o.data.readers.error import DataError
from torchrl_h2o.data.readers.ted import require_ted


class AuditedSimulation(Protocol):
    """What an audit needs of a simulator; ``torchrl_h2o.residuals.Simulation`` provides it."""

    @property
    def state_map(self) -> Any: ...

    @property
    def model(self) -> Any: ...
    @property
    def control_step(self) -> float: ...
    @property
    def actuators(self) -> tuple[str, ...]: ...
    @property
    def frame_skip(self) -> int: ...
    def with_effects(self, *effects: Any) -> Any: ...
    def executed(self, actions: np.ndarray) -> np.ndarray: ...
    def true_observations(self, observations: np.ndarray) -> np.ndarray: ...
    def activations(self, actions: np.ndarray) -> np.ndarray: ...
    def rollout(
        self,
        states: np.ndarray,
        actions: np.ndarray,
        *,
        activations: np.ndarray | None = None,
        applied: np.ndarray | None = None,
    ) -> np.ndarray: ...
    def follow(
        self, states: np.ndarray, actions: np.ndarray, time: np.ndarray, activations: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]: ...


@dataclass(frozen=True)
class Pair:
    """The columns of a position and of its velocity.

    Args:
        name: name of the position.
        velocity_name: name of the velocity.
        position: column of the position.
        velocity: column of the velocity.
        coordinate: index of the position in qpos.
        dof: index of the velocity in qvel.
        angle: whether the position is an angle in rad; otherwise a distance in m.
    """

    name: str
    velocity_name: str
    position: int
    velocity: int
    coordinate: int
    dof: int
    angle: bool

    @property
    def unit(self) -> str:
        return "rad" if self.angle else "m"


@dataclass(frozen=True)
class Velocity:
    """The column of a joint's velocity.

    Args:
        name: name of the position if it is observed as well; otherwise of the velocity.
        column: column of the velocity.
        dof: its index in qvel.
        actuators: indices of the actuators that drive the joint directly.
    """

    name: str
    column: int
    dof: int
    actuators: tuple[int, ...] = ()


@dataclass(frozen=True)
class Turning:
    """The columns of a body that turns about any axis: of a free joint or a ball joint whose quaternion is observed.

    Args:
        name: name of the joint.
        quaternion: columns of w, x, y and z.
        rates: columns of the angular velocities; empty if one of them is not observed.
        place: columns of a free joint's place; empty if one is not observed.
        velocity: columns of its velocity; empty if one is not observed.
    """

    name: str
    quaternion: tuple[int, ...]
    rates: tuple[int, ...]
    place: tuple[int, ...] = ()
    velocity: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class Log:
    """Measured transitions and the meaning of their columns.

    Args:
        observation: (T, n), before the action.
        action: (T, nu).
        following: (T, n), after the action.
        run: (T,), index of the unbroken run of each transition.
        ended: (T,), whether the data mark the end of a run after this transition; None if they do not tell.
        time: (T,), stamps in s; None without stamps.
        dt: the control step of the simulator, in s.
        names: names of the observations, (n,).
        units: units of the observations, (n,).
        actuators: names of the actions, (nu,).
        pairs: positions with an observed velocity.
        velocities: the velocities of the pairs, in their order, then those of driven joints without a position, such
            as a wheel whose speed alone is measured.
        clipped: (T,), transitions with a value at the end of the range that the simulator's own sensors have.
        estimated_std: (n,), errors of columns that were estimated from others, 0 for measured ones; None if none was.
        alone: names of the positions whose velocity is not observed.
        turning: bodies whose quaternion is observed.
        touching: (T,), rows in which a contact of the model makes its response meaningless; None for none.
    """

    observation: np.ndarray
    action: np.ndarray
    following: np.ndarray
    run: np.ndarray
    ended: np.ndarray | None
    time: np.ndarray | None
    dt: float
    names: tuple[str, ...]
    units: tuple[str, ...]
    actuators: tuple[str, ...]
    pairs: tuple[Pair, ...]
    velocities: tuple[Velocity, ...]
    clipped: np.ndarray
    estimated_std: np.ndarray | None = None
    alone: tuple[str, ...] = ()
    turning: tuple[Turning, ...] = ()
    touching: np.ndarray | None = None

    @classmethod
    def of(cls, measured: TensorDictBase | Any, simulation: AuditedSimulation) -> Log:
        """Converts transitions, TED or ``torchrl_h2o.residuals.Measured``, and checks them against the simulator.

        Raises:
            DataError: if they are no valid TED, hold no row or a value that is not finite, or do not have
                the simulator's width.
        """
        state_map, ended, time, estimated_std = simulation.state_map, None, None, None
        if not isinstance(measured, TensorDictBase) and not hasattr(measured, "following"):
            raise DataError(f"an audit needs transitions, not {type(measured).__name__}", "read them with load(...)")
        if isinstance(measured, TensorDictBase):
            require_ted(measured)
            observation, action = _float64(measured["observation"]), _float64(measured["action"])
            following = _float64(measured["next", "observation"])
            ended = cast("torch.Tensor", measured["next", "done"]).flatten().numpy()
            breaks = ended[:-1] | (following[:-1] != observation[1:]).any(1)
            run = np.concatenate([[0], np.cumsum(breaks)])
            if "time" in measured.keys():
                time = _float64(measured["time"]).flatten()
            if "observation_std" in measured.keys():
                estimated_std = np.sqrt((_float64(measured["observation_std"]) ** 2).mean(0))
        else:
            observation, action, following = measured.observation, measured.action, measured.following
            run, time, estimated_std = measured.run, measured.time, measured.estimated_std
        _require_width(observation, state_map.names, "observation")
        _require_width(action, simulation.actuators, "action")
        named = (observation, state_map.names), (following, state_map.names), (action, simulation.actuators)
        for values, names in named:
            _require_finite(values, names)
        clipped = state_map.clipped(observation) | state_map.clipped(following)
        pairs = find_pairs(state_map, simulation.model)
        velocities, turning = _velocities(pairs, state_map, simulation.model), find_turning(state_map, simulation.model)
        alone, names, units = positions_alone(state_map, simulation.model), state_map.names, state_map.units
        arrays = observation, action, following, run, ended, time
        columns = simulation.control_step, tuple(names), tuple(units), simulation.actuators, pairs, velocities
        return cls(*arrays, *columns, clipped, estimated_std, alone, turning)

    def __len__(self) -> int:
        return len(self.observation)

    def moved_by(self, actuator: int) -> str:
        """Name of the joint that an actuator drives, or of the actuator if no velocity of such a joint is observed."""
        return next((one.name for one in self.velocities if actuator in one.actuators), self.actuators[actuator])

    @property
    def runs(self) -> list[slice]:
        """Rows of each unbroken run."""
        edges = np.flatnonzero(np.diff(self.run)) + 1
        return [slice(a, b) for a, b in zip([0, *edges.tolist()], [*edges.tolist(), len(self)], strict=True)]

    def starts(self, horizon: int, most: int, margin: int = 0, without: np.ndarray | None = None) -> np.ndarray:
        """First rows of windows that overlap by half at most, evenly thinned, (W,).

        Args:
            horizon: transitions per window.
            most: largest number of windows.
            margin: rows of the same run that have to precede a window.
            without: rows (T,) that no window contains, beside the clipped ones.
        """
        starts = np.arange(margin, len(self) - horizon + 1)
        bad = np.concatenate([[0], np.cumsum(self.clipped if without is None else self.clipped | without)])
        whole = self.run[starts - margin] == self.run[starts + horizon - 1]
        starts = starts[whole & (bad[starts + horizon] == bad[starts])]
        apart = starts[:: max(1, horizon // 2)]
        return apart[np.unique(np.linspace(0, len(apart) - 1, min(most, len(apart))).round().astype(int))]


def find_pairs(state_map: Any, model: Any) -> tuple[Pair, ...]:
    """Positions and velocities of the same degree of freedom among the observations.

    Quaternions have no pairs, and columns that are not single coordinates of the state have none.
    """
    column, pairs = _single_columns(state_map), []
    for position, dof, angle in _scalar_coordinates(model):
        velocity = model.nq + dof
        if position in column and velocity in column:
            p, v = column[position], column[velocity]
            pairs.append(Pair(state_map.names[p], state_map.names[v], p, v, position, dof, angle))
    return tuple(pairs)


def _velocities(pairs: tuple[Pair, ...], state_map: Any, model: Any) -> tuple[Velocity, ...]:
    driven: dict[int, list[int]] = {}
    for actuator in range(model.nu):
        joint = int(model.actuator_trnid[actuator, 0])
        # mjtTrn: 0, 1 joint; mjtJoint: 2 slide, 3 hinge
        if int(model.actuator_trntype[actuator]) in (0, 1) and int(model.jnt_type[joint]) in (2, 3):
            driven.setdefault(int(model.jnt_dofadr[joint]), []).append(actuator)
    found = [Velocity(pair.name, pair.velocity, pair.dof, tuple(driven.pop(pair.dof, ()))) for pair in pairs]
    column = _single_columns(state_map)
    for dof, actuators in driven.items():
        if (place := column.get(model.nq + dof)) is not None:
            found.append(Velocity(state_map.names[place], place, dof, tuple(actuators)))
    return tuple(found)


def positions_alone(state_map: Any, model: Any) -> tuple[str, ...]:
    """Names of the observed positions whose velocity is not observed."""
    column = _single_columns(state_map)
    return tuple(
        state_map.names[column[position]]
        for position, dof, _ in _scalar_coordinates(model)
        if position in column and model.nq + dof in state_map.hidden
    )


def find_turning(state_map: Any, model: Any) -> tuple[Turning, ...]:
    """The bodies on free joints and ball joints whose quaternion is observed."""
    column, found = _single_columns(state_map), []

    def columns(first: int, number: int) -> tuple[int, ...]:
        observed = tuple(column[index] for index in range(first, first + number) if index in column)
        return observed if len(observed) == number else ()

    for joint in range(model.njnt):
        kind, position = int(model.jnt_type[joint]), int(model.jnt_qposadr[joint])
        velocity = model.nq + int(model.jnt_dofadr[joint])
        if kind > 1:  # mjtJoint: 0 free, 1 ball
            continue
        places = (columns(position, 3), columns(velocity, 3)) if kind == 0 else ((), ())
        shift = 3 if kind == 0 else 0
        if quaternion := columns(position + shift, 4):
            name = model.joint(joint).name or f"joint_{joint}"
            found.append(Turning(name, quaternion, columns(velocity + shift, 3), *places))
    return tuple(found)


def _single_columns(state_map: Any) -> dict[int, int]:
    """Column of each coordinate of the state that an observation shows as it is."""
    single = (np.abs(state_map.observe) == 1.0).sum(1) == (state_map.observe != 0.0).sum(1)
    single &= (state_map.observe != 0.0).sum(1) == 1
    return {int(np.argmax(row)): i for i, row in enumerate(state_map.observe) if single[i] and row.max() == 1.0}


def _scalar_coordinates(model: Any) -> Iterator[tuple[int, int, bool]]:
    """Each position that is a number of its own: its index in qpos, that of its velocity in qvel, and if it is a hinge.

    These are hinges, slides, and the three translations of a free joint.
    """
    for joint in range(model.njnt):
        kind, coordinate, dof = int(model.jnt_type[joint]), int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        for axis in range({0: 3, 1: 0}.get(kind, 1)):  # mjtJoint: 0 free, 1 ball, 2 slide, 3 hinge
            yield coordinate + axis, dof + axis, kind == 3


def _float64(tensor: Any) -> np.ndarray:
    return tensor.detach().cpu().double().numpy()


def _require_finite(values: np.ndarray, names: Sequence[str]) -> None:
    if len(values) == 0:
        raise DataError("the data hold no transitions", "select some rows")
    if not (finite := np.isfinite(values)).all():
        row, column = np.argwhere(~finite)[0]
        raise DataError(f"row {row} of {names[column]} is {values[row, column]}", "leave out or repair such rows")


def _require_width(values: np.ndarray, names: Sequence[str], what: str) -> None:
    if values.shape[1] != len(names):
        raise DataError(
            f"the data have {values.shape[1]} entries, the simulator has {len(names)} ({', '.join(names)})",
            "choose the simulator that matches the data, or name the columns in the simulator's order",
            column=what,
        )
