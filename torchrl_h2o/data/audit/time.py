"""Checks of the time stamps and of the time step against the motion and the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from torchrl_h2o.data.audit.derivative import KNOWN_FACTOR, RELATED, SCALE_SEVERE, SCALE_WARNING, Derivative
from torchrl_h2o.data.audit.finding import Finding, Rows
from torchrl_h2o.data.audit.log import AuditedSimulation, Log
from torchrl_h2o.data.audit.physics import BETTER
from torchrl_h2o.data.audit.response import MIN_WINDOWS, PHYSICS_STEPS, ZERO_NUDGE, Response

CHECK = "time"
STEP_OFF = 0.02  # share by which the median time step may differ from the simulator's control step
STEP_FAR_OFF = 0.3  # share beyond which that difference is severe
LATE_STEP = 0.2  # share of the median step by which a single step may differ before it is irregular
IRREGULAR = 0.003  # share of irregular steps from which they are a warning, not a note
VERY_IRREGULAR = 0.05  # the share from which they are severe
SHORT_RUNS = 50.0  # mean rows between two splits of a log with stamps below which a warning is given
VERY_SHORT_RUNS = 15.0  # the number below which it is severe
FEW_ROWS_PER_PERIOD = 6.0  # rows per period of the model's fastest oscillation below which a note is given
STEP_MULTIPLES = (2, 3, 4, 5, 10)  # control steps per row that are tried
SAME_FACTOR = 0.1  # relative spread of all joints' factors within which the time is wrong, not the units


def check_time(log: Log, simulation: AuditedSimulation, derivatives: Sequence[Derivative]) -> list[Finding]:
    """Checks the stamps, the time step that the velocities imply, and the rows per period of an oscillation."""
    return [
        *_stamps(log),
        *_step_of_motion(log, derivatives),
        *_periods(log, simulation),
    ]


def common_factor(derivatives: Sequence[Derivative]) -> float | None:
    """Factor between all positions' derivatives and their velocities, if it is the same and is not a unit of angle.

    A single joint has a common factor only if it is that of ms and s, because it cannot tell time from units.
    """
    clear = [d for d in derivatives if abs(d.correlation) > RELATED]
    if not clear or len(clear) < 0.5 * len(derivatives):
        return None
    factors = np.array([d.factor for d in clear])
    middle = float(np.median(factors))
    low, high = SCALE_WARNING
    close = np.abs(factors - middle) <= SAME_FACTOR * abs(middle)
    if low <= middle <= high or close.mean() < 0.7:
        return None
    thousand = any(abs(middle / known - 1.0) < KNOWN_FACTOR for known in (1e3, 1e-3))
    degrees = any(abs(abs(middle) / known - 1.0) < KNOWN_FACTOR for known in (np.degrees(1), np.radians(1)))
    if thousand or (len(clear) > 1 and not degrees):
        return middle
    return None


def _stamps(log: Log) -> list[Finding]:
    if log.time is None or len(log) < 2:
        return []
    within = np.append(log.run[1:] == log.run[:-1], False)
    step = np.append(np.diff(log.time), np.nan)
    rows = np.flatnonzero(within)
    if not len(rows):
        return []
    usual, found = float(np.median(step[rows])), []
    ratio = usual / log.dt
    if abs(ratio - 1.0) > STEP_OFF:
        found.append(_wrong_step(usual, log.dt))
    standing = rows[step[rows] <= 0.0]
    if len(standing):
        remedy = "sort out the order of the rows, or use the stamps of the sensors instead of those of the logger"
        found.append(Finding(CHECK, "severe", "time stands still or runs backwards", Rows.of(standing), remedy))
    found += _splits(log)
    late = rows[(np.abs(step[rows] - usual) > LATE_STEP * abs(usual)) & (step[rows] > 0.0)]
    share = len(late) / len(rows)
    if len(late):
        severity = "severe" if share > VERY_IRREGULAR else "warning" if share > IRREGULAR else "note"
        words = f"{share:.2%} of the time steps differ from the usual {usual:.4g} s by more than {LATE_STEP:.0%}, "
        words += f"between {step[rows].min():.4g} and {step[rows].max():.4g} s; the simulator takes equal steps"
        remedy = "split the log at late rows (on_time_jump: split with a smaller time_tolerance)"
        remedy += f", or write resample: {log.dt:.3g} for a regular clock" if severity != "note" else ""
        found.append(Finding(CHECK, severity, words, Rows.of(late), remedy))
    return found


def _splits(log: Log) -> list[Finding]:
    """Reports a log that its reader had to split at irregular stamps again and again."""
    runs = int(log.run[-1]) + 1
    rows = len(log) / runs
    if runs < 10 or rows >= SHORT_RUNS:
        return []
    severity = "severe" if rows < VERY_SHORT_RUNS else "warning"
    words = f"the log breaks into {runs} runs of {rows:.0f} rows on average: its time steps are irregular"
    return [Finding(CHECK, severity, words, None, f"log with a regular clock, or write resample: {log.dt:.3g}")]


def _wrong_step(usual: float, dt: float) -> Finding:
    ratio = usual / dt
    if abs(ratio / 1e3 - 1.0) < KNOWN_FACTOR:
        cause = ": the stamps look like ms that are declared as s"
    elif abs(ratio * 1e3 - 1.0) < KNOWN_FACTOR:
        cause = ": the stamps look like s that are declared as ms"
    else:
        cause = ""
    severity = "severe" if abs(ratio - 1.0) > STEP_FAR_OFF else "warning"
    words = f"the median time step is {usual:.4g} s, the simulator's control step {dt:.4g} s{cause}"
    remedy = "correct the unit of the time column, or give the simulator the log's time step"
    return Finding(CHECK, severity, words, None, remedy)


def _step_of_motion(log: Log, derivatives: Sequence[Derivative]) -> list[Finding]:
    factor = common_factor(derivatives)
    if factor is None:
        return []
    step, low, high = factor * log.dt, *SCALE_SEVERE
    if factor < 0.0:
        words = "all positions move against their velocities: the rows are in reverse order, or all velocities have "
        words += "the wrong sign"
        remedy = "put the rows into the order of their recording"
    else:
        words = f"all positions change as if the time between two rows were {step:.4g} s; it is given as {log.dt:.4g} s"
        for known, unit in ((1e-3, "ms that are declared as s"), (1e3, "s that are declared as ms")):
            if abs(factor / known - 1.0) < KNOWN_FACTOR:
                words += f". The time looks like {unit}"
        remedy = "correct dt or the unit of the time column (or the units of all velocities)"
    severity = "warning" if low <= factor <= high else "severe"
    return [Finding(CHECK, severity, words, None, remedy)]


def check_step(step: Response | None) -> list[Finding]:
    """Whether the simulator reproduces the rows with a multiple of its control step, but not with one step."""
    if step is None:
        return []
    columns = [column for pair in step.log.pairs for column in (pair.position, pair.velocity)]
    few = replace(step.for_hypotheses(), moving=np.array(columns))
    misfit = few.misfit()
    left = {
        number: few.misfit(actions=lambda actions, number=number: np.repeat(actions, number, axis=1))
        for number in STEP_MULTIPLES
        if number * few.simulation.frame_skip <= PHYSICS_STEPS // MIN_WINDOWS
    }
    if not left or min(left.values()) > BETTER * misfit:
        return []
    number = min(left, key=lambda multiple: left[multiple])
    dt = step.log.dt
    words = f"the simulator leads from row to row in {number * dt:.4g} s, not in its control step of {dt:.4g} s: rows "
    remedy = "give the time between two rows, or log every row"
    return [Finding(CHECK, "severe", words + "were left out, or dt is wrong", None, remedy)]


def _periods(log: Log, simulation: AuditedSimulation) -> list[Finding]:
    """Compares the control step with the fastest undamped oscillation of the model, linearised at measured rows."""
    import mujoco  # here, because replay buffers work without it

    model = simulation.model
    if model.nv == 0 or model.nq != model.nv:
        return []
    data, frequencies = mujoco.MjData(model), []
    states = simulation.state_map.states(log.observation[np.linspace(0, len(log) - 1, 9).astype(int)])
    for state in states:
        data.qpos, data.qvel = state[: model.nq], 0.0
        mujoco.mj_forward(model, data)
        mass = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass)
        stiffness = np.zeros((model.nv, model.nv))
        still = data.qfrc_bias - data.qfrc_passive
        for column in range(model.nv):  # gravity and springs; contacts are left out
            data.qpos = state[: model.nq]
            data.qpos[column] += ZERO_NUDGE
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            stiffness[:, column] = (data.qfrc_bias - data.qfrc_passive - still) / ZERO_NUDGE
        if np.isfinite(stiffness).all():
            values = np.linalg.eigvals(np.linalg.solve(mass, stiffness))
            frequencies.append(np.sqrt(max(0.0, float(values.real.max()))))
    fastest = float(np.median(frequencies)) if frequencies else 0.0
    rows = 2.0 * np.pi / (fastest * log.dt) if fastest > 0.0 else np.inf
    if rows >= FEW_ROWS_PER_PERIOD:
        return []
    words = (
        f"the model's fastest oscillation has a period of {2.0 * np.pi / fastest:.3g} s, {rows:.1f} rows of the log: "
    )
    remedy = "record faster, if single joints and their springs matter"
    return [Finding(CHECK, "note", words + "effects on it show within single rows only", None, remedy)]
