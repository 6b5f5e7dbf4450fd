"""Cases from the logs of three real machines; the option ``logs`` names their folder."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from cases import Case, Family
from pendulum import MODEL_PATH
from tensordict import TensorDict

from torchrl_h2o.data import load
from torchrl_h2o.effects import ActionDelay, ActionLag, JointDamping, JointFrictionLoss, RollingResistance
from torchrl_h2o.envs import WheelLeggedEnv
from torchrl_h2o.residuals import Measured, Report, Simulation, Split, horizon_errors, residuals

# RMSE 100 ms ahead of a direct linear predictor, in m/s, rad and rad/s, and the multiple of it to reach
LINEAR_FLOOR = {"x_velocity": 0.067, "pitch": 0.021, "pitch_velocity": 0.27}
TO_REACH = {"x_velocity": 1.2, "pitch": 1.7, "pitch_velocity": 1.45}
AHEAD = 0.1  # s
LATE = (0.010, 0.020)  # s
WINDOW = 0.2  # s
CONTROL_STEP = 0.005  # s, of the robot's and the simple pendulum's log
DOUBLE_PENDULUM = ("shoulder", "elbow", "shoulder_velocity", "elbow_velocity")
DOUBLE_PENDULUM_STEP = 0.002  # s
TO_FALL = 0.65  # share of the median angle error


@dataclass(frozen=True, kw_only=True)
class LogCase(Case):
    """A case with a log as data.

    Args:
        path: of the log, or of several.
        columns: the name of its layout.
    """

    path: Path | tuple[Path, ...]
    columns: str

    def simulation(self) -> Simulation:
        if self.system == "wheel_legged":
            return Simulation.from_env(WheelLeggedEnv())
        if isinstance(self.path, tuple):
            model = self.path[0].with_name("double_pendulum.xml")
            return Simulation.from_mjcf(model, DOUBLE_PENDULUM, DOUBLE_PENDULUM_STEP)
        return Simulation.from_mjcf(MODEL_PATH, ["pivot", "pivot_velocity"], CONTROL_STEP)

    def measure(self) -> TensorDict:
        return load(list(self.path) if isinstance(self.path, tuple) else self.path, columns=self.columns)

    @property
    def truth_in_words(self) -> str:
        return "not known"


def log_families(folder: Path) -> dict[str, Family]:
    """The two families of cases from logs in a folder."""
    wheel_legged = LogCase(
        name="standing_still",
        system="wheel_legged",
        judge=judge_wheel_legged,
        path=folder / "wheel_legged" / "standing_still.txt",
        columns="wheel_legged_standing_still",
    )
    pendulum = LogCase(
        name="swing_up_sac",
        system="pendulum",
        judge=judge_pendulum,
        path=folder / "simple_pendulum" / "swing_up_sac.csv",
        columns="simple_pendulum",
        held_out=0.5,
    )
    double_pendulum = LogCase(
        name="double_pendulum",
        system="double_pendulum",
        judge=judge_double_pendulum,
        path=tuple(folder / "double_pendulum" / f"trajectory_{name}.csv" for name in ("00", "02", "12", "01")),
        columns="double_pendulum",
        held_out=(3,),
    )
    return {
        "log_wheel_legged": Family(lambda number, rng: wheel_legged, 1, 1, "late, dry friction beside viscous, 100 ms"),
        "log_pendulum": Family(
            lambda number, rng: (pendulum, double_pendulum)[number],
            2,
            2,
            "simple: Coulomb friction, pushes set aside, error halved; double: dry friction and armature, error − 65 %",
        ),
    }


def judge_wheel_legged(report: Report, case: LogCase) -> dict:
    """Passed on actuation delay of 10 to 20 ms, dry and viscous friction, and the error 100 ms ahead."""
    ahead = _nearest_horizon(report)
    multiples = {name: ahead.get(name, np.inf) / floor for name, floor in LINEAR_FLOOR.items()}
    lateness = [_seconds(effect) for effect in report.effects if isinstance(effect, ActionDelay | ActionLag)]
    dry = any(isinstance(effect, JointFrictionLoss | RollingResistance) for effect in report.effects)
    viscous = any(isinstance(effect, JointDamping) for effect in report.effects)
    late = LATE[0] <= sum(lateness) <= LATE[1]
    close = all(multiples[name] <= limit for name, limit in TO_REACH.items())
    return {"ok": late and dry and viscous and close, "lateness": sum(lateness), "dry": dry, "viscous": viscous} | {
        f"{name}_over_floor": multiple for name, multiple in multiples.items()
    }


def _seconds(effect: ActionDelay | ActionLag) -> float:
    return effect.delay if isinstance(effect, ActionDelay) else effect.time_constant


def _nearest_horizon(report: Report) -> dict[str, float]:
    """Error of the corrected simulator by dimension, at the horizon nearest to 100 ms."""
    if report.error is None or not report.error.horizons:
        return {}
    return dict(min(report.error.horizons, key=lambda horizon: abs(horizon.seconds - AHEAD)).after)


def judge_pendulum(report: Report, case: LogCase) -> dict:
    """Passed if Coulomb friction is named, pushes are excluded, and the median window error is halved."""
    simulation = case.simulation()
    measured = Measured.from_ted(case.measure(), simulation, held_out=case.held_out)
    before = median_window_error(simulation, measured)
    after = median_window_error(simulation.with_effects(*report.effects), measured)
    friction = any(isinstance(effect, JointFrictionLoss) for effect in report.effects)
    pushes = len(report.unexplained_intervals)
    return {
        "ok": friction and pushes > 0 and after <= 0.5 * before,
        "friction": friction,
        "pushes": pushes,
        "window_before": before,
        "window_after": after,
    }


def judge_double_pendulum(report: Report, case: LogCase) -> dict:
    """Passed on dry friction at both joints, armature at the elbow, and the median angle errors 100 ms ahead."""
    simulation = case.simulation()
    measured = Measured.from_ted(case.measure(), simulation, held_out=case.held_out)
    steps = round(AHEAD / DOUBLE_PENDULUM_STEP)
    ahead = (
        horizon_errors(which, measured, [steps])[0].median[:2]
        for which in (simulation, simulation.with_effects(*report.effects))
    )
    before, after = ahead
    mended = simulation.with_effects(*report.effects).model
    friction = bool((mended.dof_frictionloss > 0.0).all())
    armature = bool(mended.dof_armature[1] > 0.0)
    fallen = 1.0 - after / before
    return {
        "ok": friction and armature and bool((fallen >= TO_FALL).all()),
        "friction": friction,
        "armature": armature,
        "shoulder_fell_by": float(fallen[0]),
        "elbow_fell_by": float(fallen[1]),
    }


def median_window_error(simulation: Simulation, measured: Measured, seconds: float = WINDOW) -> float:
    """Median over held-out windows of the angle's RMS error within a window, rad."""
    horizon = round(seconds / simulation.control_step)
    starts = measured.windows(horizon, horizon // 2, split=Split.REPORT)
    errors = residuals(simulation, measured, starts, horizon)[:, :, 0]
    return float(np.median(np.sqrt((errors**2).mean(1))))
