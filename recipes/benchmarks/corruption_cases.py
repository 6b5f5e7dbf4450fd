"""The 30 damages of the benchmark: what each does to the rows of a log, and the checks that are responsible for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from corruption_logs import DamagedLog, GoodLog

DEGREES = 180.0 / np.pi
BLOCK = 50  # rows


@dataclass(frozen=True)
class Corruption:
    """A damage.

    Args:
        name: in words.
        checks: names of the checks that are responsible; empty if the reader must refuse the file.
        damage: returns the damaged rows; the generator draws joints and rows.
    """

    name: str
    checks: tuple[str, ...]
    damage: Callable[[GoodLog, np.random.Generator], DamagedLog]


def _times(which: str, factor: float, all_joints: bool) -> Callable[[GoodLog, np.random.Generator], DamagedLog]:
    def damage(good: GoodLog, rng: np.random.Generator) -> DamagedLog:
        pairs = good.pairs if all_joints else (_joint(good, rng),)
        chosen = {"position": (0,), "velocity": (1,), "both": (0, 1)}[which]
        return _columns(good, [pair[i] for pair in pairs for i in chosen], lambda values: factor * values)

    return damage


def _columns(good: GoodLog, columns, change: Callable[[np.ndarray], np.ndarray]) -> DamagedLog:
    observation = good.log.observation.copy()
    observation[:, columns] = change(observation[:, columns])
    return replace(good.log, observation=observation)


def _joint(good: GoodLog, rng: np.random.Generator) -> tuple[int, int]:
    return good.pairs[rng.integers(len(good.pairs))]


def _stamps(good: GoodLog) -> np.ndarray:
    return good.step * np.arange(len(good.log.action)) if good.log.time is None else good.log.time


def _milliseconds(good: GoodLog, rng: np.random.Generator) -> DamagedLog:
    return replace(good.log, time=1e3 * _stamps(good), dt=None)


def _exchanged(position_and_velocity: bool) -> Callable[[GoodLog, np.random.Generator], DamagedLog]:
    def damage(good: GoodLog, rng: np.random.Generator) -> DamagedLog:
        if position_and_velocity:
            first, second = ([column] for column in _joint(good, rng))
        else:
            one, other = rng.choice(len(good.pairs), 2, replace=False)
            first, second = list(good.pairs[one]), list(good.pairs[other])
        columns = [*first, *second]
        return _columns(good, columns, lambda values: np.roll(values, len(first), axis=1))

    return damage


def _action_sign(good: GoodLog, rng: np.random.Generator) -> DamagedLog:
    action = good.log.action.copy()
    action[:, rng.integers(action.shape[1])] *= -1.0
    return replace(good.log, action=action)


def _action_lag(rows: int) -> Callable[[GoodLog, np.random.Generator], DamagedLog]:
    """The actions are logged some rows before they act."""

    def damage(good: GoodLog, rng: np.random.Generator) -> DamagedLog:
        return replace(good.log.take(np.arange(len(good.log.action) - rows)), action=good.log.action[rows:])

    return damage


def _filtered(good: GoodLog, rng: np.random.Generator) -> DamagedLog:
    """Velocities pass through a first-order filter with a time constant of five rows."""

    def change(values: np.ndarray) -> np.ndarray:
        filtered = values.copy()
        for row in range(1, len(values)):
            filtered[row] = filtered[row - 1] + (values[row] - filtered[row - 1]) / 5.0
        return filtered

    return _columns(good, [velocity for _, velocity in good.pairs], change)


def _repeated(share: float) -> Callable[[GoodLog, np.random.Generator], DamagedLog]:
    def damage(good: GoodLog, rng: np.random.Generator) -> DamagedLog:
        rows = np.arange(len(good.log.action))
        lost = rng.random(len(rows)) < share
        lost[0] = False
        rows = np.maximum.accumulate(np.where(lost, 0, rows))
        return replace(good.log.take(rows), time=good.log.time)

    return damage


def _shuffled(block: int) -> Callable[[GoodLog, np.random.Generator], DamagedLog]:
    """The rows change places; stamps, if any, change places with them only if single rows do."""

    def damage(good: GoodLog, rng: np.random.Generator) -> DamagedLog:
        number = len(good.log.action) // block
        rows = (rng.permutation(number)[:, None] * block + np.arange(block)).ravel()
        shuffled = good.log.take(rows)
        return shuffled if block == 1 else replace(shuffled, time=None, dt=good.step)

    return damage


def _frozen(good: GoodLog, rng: np.random.Generator) -> DamagedLog:
    column, middle = _joint(good, rng)[rng.integers(2)], len(good.log.action) // 2
    return _columns(
        good, [column], lambda values: np.where(np.arange(len(values))[:, None] < middle, values, values[middle])
    )


def _clipped(good: GoodLog, rng: np.random.Generator) -> DamagedLog:
    limit = 0.5
    return _columns(
        good, [_joint(good, rng)[rng.integers(2)]], lambda v: np.clip(v, limit * v.min(0), limit * v.max(0))
    )


def _quantised(good: GoodLog, rng: np.random.Generator) -> DamagedLog:
    def change(values: np.ndarray) -> np.ndarray:
        step = 0.25 * values.std(0)
        return step * np.round(values / step)

    return _columns(good, [_joint(good, rng)[rng.integers(2)]], change)


def _noisy(good: GoodLog, rng: np.random.Generator) -> DamagedLog:
    spread = good.log.observation.std(0)
    noise = 0.3 * spread * rng.standard_normal(good.log.observation.shape)
    return replace(good.log, observation=good.log.observation + noise)


def _irregular(good: GoodLog, rng: np.random.Generator) -> DamagedLog:
    """Stamps with steps between 0.6 and 1.4 of the control step."""
    steps = good.step * rng.uniform(0.6, 1.4, len(good.log.action))
    return replace(good.log, time=np.cumsum(steps), dt=None)


def _step_twice(good: GoodLog, rng: np.random.Generator) -> DamagedLog:
    """The declared step is twice the real one; where the simulator fixes the step, every second row is left out."""
    if good.log.dt is None:
        return replace(good.log, time=None, dt=2.0 * good.step)
    return good.log.take(np.arange(0, len(good.log.action), 2))


def _wrapped(good: GoodLog, rng: np.random.Generator) -> DamagedLog:
    """An encoder that counts from 0 to 2 π."""
    return _columns(good, [_joint(good, rng)[0]], lambda values: np.mod(values, 2.0 * np.pi))


def _text(edit: Callable[[str], str]) -> Callable[[GoodLog, np.random.Generator], DamagedLog]:
    return lambda good, rng: replace(good.log, edit=edit)


def _not_a_number(good: GoodLog, rng: np.random.Generator) -> DamagedLog:
    observation = good.log.observation.copy()
    observation[rng.integers(len(observation), size=3)] = np.nan
    return replace(good.log, observation=observation)


def _shifted_zero(good: GoodLog, rng: np.random.Generator) -> DamagedLog:
    return _columns(good, [_joint(good, rng)[0]], lambda values: values + 0.3)


CORRUPTIONS = (
    Corruption("angles in degrees", ("kinematics",), _times("position", DEGREES, True)),
    Corruption("angular velocities in degrees per second", ("kinematics",), _times("velocity", DEGREES, True)),
    Corruption("both in degrees", ("model", "kinematics"), _times("both", DEGREES, True)),
    Corruption("stamps in ms declared as s", ("time",), _milliseconds),
    Corruption("velocity and position of a joint exchanged", ("kinematics",), _exchanged(True)),
    Corruption("two joints exchanged", ("model", "actions"), _exchanged(False)),
    Corruption("sign of a velocity", ("kinematics",), _times("velocity", -1.0, False)),
    Corruption("sign of an angle", ("kinematics",), _times("position", -1.0, False)),
    Corruption("sign of an action", ("actions",), _action_sign),
    Corruption("actions 5 rows off", ("actions",), _action_lag(5)),
    Corruption("actions 20 rows off", ("actions",), _action_lag(20)),
    Corruption("filtered velocities", ("kinematics",), _filtered),
    Corruption("5 % of the rows repeated", ("rows",), _repeated(0.05)),
    Corruption("30 % of the rows repeated", ("rows",), _repeated(0.3)),
    Corruption("rows shuffled", ("rows",), _shuffled(1)),
    Corruption("blocks of rows shuffled", ("rows",), _shuffled(BLOCK)),
    Corruption("a column frozen from the middle", ("rows",), _frozen),
    Corruption("a column clipped at half its range", ("rows",), _clipped),
    Corruption("a column quantised", ("rows",), _quantised),
    Corruption("actions of another run", ("actions",), lambda good, rng: _with_action(good, good.other_actions)),
    Corruption("actions constant", ("actions",), lambda good, rng: _with_action(good, _mean_action(good))),
    Corruption("actions × 1000", ("actions",), lambda good, rng: _with_action(good, 1e3 * good.log.action)),
    Corruption("another robot's log", ("model", "actions", "time"), lambda good, rng: good.other_robot),
    Corruption("30 % noise", ("kinematics",), _noisy),
    Corruption("irregular time", ("time",), _irregular),
    Corruption("declared step wrong by a factor of 2", ("time",), _step_twice),
    Corruption("a wrapped angle", ("kinematics",), _wrapped),
    Corruption("zero of an angle off by 0.3 rad", ("model",), _shifted_zero),
    Corruption("last line cut off", (), _text(lambda text: text[: len(text) - 1 - len(text.splitlines()[-1]) // 2])),
    Corruption("rows with NaN", (), _not_a_number),
)


def _with_action(good: GoodLog, action: np.ndarray) -> DamagedLog:
    rows = min(len(action), len(good.log.action))
    return replace(good.log.take(np.arange(rows)), action=action[:rows])


def _mean_action(good: GoodLog) -> np.ndarray:
    return np.tile(good.log.action.mean(0), (len(good.log.action), 1))
