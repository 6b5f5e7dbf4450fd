"""Measures how often the value of a log lies in the 95 % interval that the other logs of its machine gave for it.

python recipes/benchmarks/interval_coverage.py                     # simulated arms, 10 minutes
python recipes/benchmarks/interval_coverage.py logs=path/to/logs   # also the real double pendulum, logs/double_pendulum

Each log of a series is left out in turn. A known set of effects is fitted to the other logs, with intervals of the
values in another log, and to this log alone. Writes a record for each series to outputs/benchmark/interval_coverage and
skips those that the same commit has recorded there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from chains import MODEL_STEPS
from corruption_logs import pendulum_simulation
from options import read_options
from servo_cases import NOISE, ServoCase, effects_of, judge_servo, with_cause
from servos import STEP, SUBSTEPS, Arm, Servo
from tensordict import TensorDict

import torchrl_h2o.quiet  # noqa: F401  (silences other packages)
from torchrl_h2o.comparison.records import Record, read_records
from torchrl_h2o.data import load
from torchrl_h2o.effects import Armature, Effect, JointDamping, JointFrictionLoss
from torchrl_h2o.provenance import cpu_seconds
from torchrl_h2o.residuals import Measured, Simulation
from torchrl_h2o.residuals.ground import Ground
from torchrl_h2o.residuals.intervals import CONFIDENCE
from torchrl_h2o.residuals.search import known_set, with_intervals

TABLE = "coverage"
LOGS, ROWS = 5, 1500  # logs of a series of arms, and rows of each: 15 s
SCATTER = (0.1, 0.2)  # standard deviation of a value between the arms of a series, as a share of its mean
SCATTERED = ("friction", "damping", "rotor", "load")  # parts of a servo that differ between the arms of a series
#: joints and friction of each series of arms: M1 is dry and viscous, M3 also grows with the load
ARMS = (*((1, "M1"), (1, "M3")) * 4, *((3, "M1"),) * 3)
LATER = 0.5 * STEP * (1.0 / MODEL_STEPS - 1.0 / SUBSTEPS)  # s by which a servo acts later in the model than in reality


@dataclass(frozen=True)
class Series:
    """Several logs of one machine, and the effects that its simulator lacks.

    Args:
        machine: what the machine is, in words.
        simulation: the simulator without the effects.
        data: TED ``(T,)`` with the entry ``"log"``.
        effects: the effects, with values from which the fits begin.
        truths: the effects with the true values in each log; empty if nobody knows them.
    """

    machine: str
    simulation: Simulation
    data: TensorDict
    effects: tuple[Effect, ...]
    truths: tuple[tuple[Effect, ...], ...] = ()


@dataclass(frozen=True)
class LeftOut:
    """A value of a log that was left out, and what the other logs say of it.

    Args:
        name: name of the effect and of its parameter.
        log: index of the log.
        value: the value in the other logs.
        half_width: half-width of its 95 % interval in another log.
        own: the value in this log alone.
        own_half_width: half-width of the 95 % interval of this.
        true: the true value in this log; None if nobody knows it.
    """

    name: str
    log: int
    value: float
    half_width: float
    own: float
    own_half_width: float
    true: float | None = None

    @property
    def z(self) -> float:
        """Distance of the log's own value from that of the others, in standard errors of both."""
        return CONFIDENCE * (self.own - self.value) / math.hypot(self.half_width, self.own_half_width)


def counts(rows: Iterable[LeftOut]) -> dict[str, int]:
    """How many values, and how many inside the interval, inside the one widened by the log's own, and true ones."""
    rows = list(rows)
    known = [(abs(row.true - row.value), row.half_width) for row in rows if row.true is not None]
    return {
        "values": len(rows),
        "inside": sum(abs(row.own - row.value) <= row.half_width for row in rows),
        "inside_widened": sum(abs(row.z) <= CONFIDENCE for row in rows),
        "truths": len(known),
        "truths_inside": sum(distance <= half for distance, half in known),
    }


def arms(number: int, seed: int) -> Series:
    """Draw a series of arms, of which each log is of another one; every other series has positions alone."""
    rng = np.random.default_rng([seed, number])
    count, cause = ARMS[number]
    mean = with_cause(Arm.draw(rng, count), cause, rng)
    scatter, noise, has_velocities = rng.uniform(*SCATTER), float(rng.uniform(*NOISE)), number // 2 % 2 == 1
    cases = [
        ServoCase(
            name="",
            system="arm",
            judge=judge_servo,
            noise=noise,
            seed=int(rng.integers(2**31)),
            transitions=ROWS,
            machine=Arm(tuple(_scattered(servo, scatter, rng) for servo in mean.servos)),
            cause=cause,
            velocities=has_velocities,
        )
        for _ in range(LOGS)
    ]
    logs = [case.measure() for case in cases]
    for index, log in enumerate(logs):
        log["log"] = torch.full((len(log),), index)
    truths = tuple(_effects(case.machine) for case in cases)
    machine = f"simulated arms of {count} joint{'s' * (count > 1)}{', friction by load' * (cause == 'M3')}"
    return Series(machine, cases[0].simulation(), TensorDict.cat(logs), _effects(mean), truths)


def _scattered(servo: Servo, scatter: float, rng: np.random.Generator) -> Servo:
    factors = 1.0 + scatter * rng.standard_normal(len(SCATTERED))
    return replace(servo, **{name: getattr(servo, name) * f for name, f in zip(SCATTERED, factors, strict=True)})


def _effects(arm: Arm) -> tuple[Effect, ...]:
    """What the model of an arm lacks; its longer steps take as much damping as makes up for later servos."""
    servos = (replace(servo, damping=servo.damping + LATER * servo.stiffness) for servo in arm.servos)
    return effects_of(Arm(tuple(servos)))


def double_pendulum(folder: Path) -> Series:
    """The real double pendulum, with friction, damping and rotors from the values that its builders published."""
    published = {"shoulder": (0.146, 0.001, 0.0028), "elbow": (0.122, 0.001, 0.0028)}
    effects = tuple(
        effect
        for joint, (friction, damping, rotor) in published.items()
        for effect in (JointFrictionLoss(friction, joint), JointDamping(damping, joint), Armature(rotor, joint))
    )
    data = load(sorted(folder.glob("trajectory_*.csv")), columns="double_pendulum")
    return Series("real double pendulum", pendulum_simulation(folder), data, effects)


def left_out(series: Series) -> Iterator[LeftOut]:
    """Leaves out each log in turn; values that a fit drops as not different from neutral are not compared."""
    logs = np.unique(series.data["log"].numpy()).tolist()
    for log in logs:
        others, own = _values(series, [log]), _values(series, [other for other in logs if other != log])
        for key in [key for key in others if key in own]:
            index, name = key
            effect = series.effects[index]
            true = series.truths[log][index].parameters[name].value if series.truths else None
            words = " ".join([type(effect).__name__, str(getattr(effect, "joints", "")), name])
            (value, _, half), (own_value, own_half, _) = others[key], own[key]
            yield LeftOut(words, log, value, half, own_value, own_half, true)


def _values(series: Series, held_out: Collection[int]) -> dict[tuple[int, str], tuple[float, float, float]]:
    """By effect and parameter, the value, and half-widths of its intervals in these logs and in another one."""
    measured = Measured.from_ted(series.data, series.simulation, held_out=held_out)
    known = known_set(series.simulation.catalogue(), series.effects)
    ground = Ground.of(series.simulation, measured, known.effects)
    found, fit, _ = with_intervals(ground, ground.found(known.entries, known.effects), [])
    names = [entry.name for entry in known.entries]
    return {
        (names.index(entry.name), name): (effect.parameters[name].value, float(half), float(another[name]))
        for entry, effect, own, another in zip(
            found.entries, fit.effects, fit.half_widths, fit.in_another_log, strict=True
        )
        for name, half in own.items()
    }


def main() -> None:
    cfg = read_options(
        series=list(range(len(ARMS))),  # of simulated arms
        seed=0,
        logs=None,  # folder of the real logs: double_pendulum/
        folder="outputs/benchmark/interval_coverage",
    )
    torch.set_num_threads(1)
    folder = Path(cfg.folder)
    made: dict[str, Callable[[], Series]] = {
        f"arms_{number:02}" + (f"_seed{cfg.seed}" if cfg.seed else ""): partial(arms, number, cfg.seed)
        for number in cfg.series
    }
    if cfg.logs is not None:
        made["double_pendulum"] = partial(double_pendulum, Path(cfg.logs) / "double_pendulum")
    done = {record.name: record for record in read_records(folder, TABLE) if record.is_current}
    for name, make in made.items():
        if name not in done:
            start, series = cpu_seconds(), make()
            rows = list(left_out(series))
            asked = len(series.effects) * len(series.data["log"].unique())
            told = {"machine": series.machine, "asked": asked, **counts(rows), "rows": [asdict(row) for row in rows]}
            done[name] = Record.of_this_process(TABLE, name, told, start)
            done[name].save(folder)
        told: Mapping = done[name].values
        z = np.array([LeftOut(**row).z for row in told["rows"]])
        print(name, *(f"{key} {told[key]}" for key in told if key != "rows"), f"z {z.mean():.2f} ± {z.std():.2f}")
    print(f"\nresults    {folder}/{TABLE}")


if __name__ == "__main__":
    main()
