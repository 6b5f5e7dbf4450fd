"""Made-up reports: one with an entry of every kind, and two without effects."""

import dataclasses

import numpy as np

from torchrl_h2o.effects import ActionGain, BodyMass, Gravity, JointFrictionLoss, LinearDrag
from torchrl_h2o.residuals.report.contents import (
    DataSummary,
    FoundEffect,
    IndistinguishableGroup,
    Interval,
    RejectedEffect,
    SearchStep,
)
from torchrl_h2o.residuals.report.document import Report
from torchrl_h2o.residuals.report.errors import (
    DimensionError,
    ErrorSummary,
    HorizonError,
    PredictedRow,
    Prediction,
    PredictionTable,
)
from torchrl_h2o.residuals.report.mended_model import LeftOut, MendedModel
from torchrl_h2o.residuals.report.residual_trace import ResidualTrace
from torchrl_h2o.residuals.report.windows import RunError, ShownWindow, WindowQuantity

DATA = DataSummary("swing_up.csv", 5000, 1500, {"a gap in time": 12, "velocity clipped at ±10 rad/s": 3})


def full_report() -> Report:
    """Three effects, one of them undeclared and one with an alternative, and the data of all pictures."""
    gravity = FoundEffect(Gravity(0.500123), True, {"scale": (0.4991, 0.5012)}, 0.011)
    mass = FoundEffect(BodyMass(1.2, "pole"), True, {"scale": (1.15, 1.26)}, 0.006)
    friction = FoundEffect(JointFrictionLoss(0.0412, "elbow"), False, {"torque": (0.0391, 0.0433)}, 0.004)
    return Report(
        simulator="double_pendulum.xml",
        data=DATA,
        error=error(),
        found=(gravity, mass, friction),
        rejected=(
            RejectedEffect(LinearDrag(0.02, "pole"), 0.00399, 0.41, "explains no more than chance"),
            RejectedEffect(ActionGain(0.83), 0.0061, 0.003, "not on the list of the best"),
            RejectedEffect(ActionGain(-9.0, (1,)), float("inf"), None, "diverges"),
        ),
        indistinguishable=(IndistinguishableGroup((BodyMass(1.21, "pole"), ActionGain(0.83, (0,))), (0.006, 0.0061)),),
        predictions=predictions(),
        unexplained_intervals=(Interval(14.2, 14.9, 70, 38.0, "a push from outside"),),
        steps=(
            SearchStep(("gravity × 0.5",), (), 0.71, 28.4),
            SearchStep((mass.words, friction.words), ("dry friction of joint wrist + 0.02 N·m",), 0.082, 9.6),
        ),
        stop_test="a permutation test of the held-out residual, at 1 %",
        wall_s=84.2,
        trace=trace(),
    )


def predictions() -> PredictionTable:
    """In total and of one joint."""
    cells = [Prediction(error, 0.9 * error, 1.1 * error) for error in (0.873, 0.0712, 0.652, 0.0698)]
    return PredictionTable(0.1, tuple(PredictedRow(name, *cells) for name in ("total", "elbow")))


def few_pictures(report: Report) -> Report:
    """The report without most of what is drawn, so that its page costs little: no trace and no error further ahead."""
    error = None if report.error is None else dataclasses.replace(report.error, horizons=())
    return dataclasses.replace(report, trace=None, windows=report.windows[:1], error=error)


def windowed() -> Report:
    """The full report with windows, runs and a model, as a file of today has them."""
    ahead = tuple(0.02 * i for i in range(6))

    def quantity(name: str, unit: str, size: float) -> WindowQuantity:
        measured, before, after = (tuple(size * gain * t for t in ahead) for gain in (1.0, 1.9, 1.05))
        return WindowQuantity(name, unit, measured, (*before[:-1], float("nan")), after)

    quantities = (quantity("elbow angle", "rad", 1.0), quantity("elbow velocity", "rad/s", 10.0))
    shown = (
        ShownWindow(rank, run, 100 * run, 2.0 * run, ahead, float("nan"), 0.1 / (1 + run), quantities)
        for run, rank in enumerate(("worst", "median", "best"))
    )
    runs = (RunError("0", 3500, 0.031, 0.004, False), RunError("1", 1500, 0.029, 0.0041, True))
    left = LeftOut(JointFrictionLoss(0.0412, "elbow"), "MJCF has no such force")
    mended = MendedModel("mended.xml", (left,))
    return dataclasses.replace(full_report(), windows=tuple(shown), runs=runs, mended_model=mended)


def error() -> ErrorSummary:
    """The errors of two angles and their two velocities, up to half a second ahead."""
    per_dimension = (
        DimensionError("shoulder angle", "rad", 0.0021, 0.00031, 0.00028),
        DimensionError("elbow angle", "rad", 0.0034, 0.00042, None),
        DimensionError("shoulder velocity", "rad/s", 0.031, 0.004, 0.003),
        DimensionError("elbow velocity", "rad/s", 0.054, 0.0061, 0.0049),
    )
    horizons = tuple(
        HorizonError(
            steps,
            steps * 0.01,
            {d.name: d.before * steps**0.9 for d in per_dimension},
            {d.name: d.after * steps**0.6 for d in per_dimension},
        )
        for steps in (1, 5, 10, 20, 50)
    )
    return ErrorSummary("held-out one-step RMSE", "rad/s", 0.031, 0.004, 0.003, per_dimension, horizons)


def trace(rows: int = 5000) -> ResidualTrace:
    """A residual with a sine and a sign before, noise after, and one push."""
    rng = np.random.default_rng(0)
    time = np.arange(rows) * 0.01
    q = np.stack([2.0 * np.sin(time), np.sin(2.3 * time + 1.0)], -1)
    v = np.stack([2.0 * np.cos(time), 2.3 * np.cos(2.3 * time + 1.0)], -1)
    after = rng.normal(size=(rows, 4)) * [0.0003, 0.0004, 0.004, 0.006]
    missing = np.concatenate([0.05 * np.sin(q), 0.04 * np.sin(q) + 0.03 * np.sign(v)], -1) * [0.06, 0.06, 1.0, 1.0]
    after[1420:1490, 2:] += 0.4
    return ResidualTrace(
        time,
        ("shoulder angle", "elbow angle", "shoulder velocity", "elbow velocity"),
        ("rad", "rad", "rad/s", "rad/s"),
        after + missing,
        after,
        np.concatenate([q, v], -1),
        np.arange(rows) >= 3500,
    )


def narrow(whole: ResidualTrace, columns: int) -> ResidualTrace:
    """The first columns of a trace."""
    parts = {name: getattr(whole, name)[:, :columns] for name in ("before", "after", "states")}
    return dataclasses.replace(whole, names=whole.names[:columns], units=whole.units[:columns], **parts)


def nothing_missing() -> Report:
    """Noise only: the error equals its floor."""
    summary = ErrorSummary("held-out one-step RMSE", "rad/s", 0.0041, 0.0041, 0.004)
    return Report(simulator="HalfCheetah-v5", data=DATA, error=summary)


def no_conclusion() -> Report:
    """Too few rows for any error."""
    return Report(simulator="HalfCheetah-v5", data=DataSummary("short.csv", 7, 0), conclusion="7 rows are too few.")


def renamed(report: Report, text: str) -> Report:
    """The report with the same text in every field that holds a name, a unit or a description."""
    summary = report.error
    dimensions = [dataclasses.replace(d, name=f"{text}{d.name}", unit=text) for d in summary.per_dimension]
    horizons = [
        HorizonError(h.steps, h.seconds, *({f"{text}{k}": v for k, v in e.items()} for e in (h.before, h.after)))
        for h in summary.horizons
    ]
    names = tuple(f"{text}{name}" for name in report.trace.names)
    return dataclasses.replace(
        report,
        simulator=text,
        data=DataSummary(text, 5000, 1500, {text: 1}),
        error=dataclasses.replace(
            summary, metric=text, unit=text, per_dimension=tuple(dimensions), horizons=tuple(horizons)
        ),
        rejected=tuple(dataclasses.replace(rejected, reason=text) for rejected in report.rejected),
        indistinguishable=tuple(dataclasses.replace(g, words=(text, text)) for g in report.indistinguishable),
        unexplained_intervals=tuple(dataclasses.replace(i, set_aside=text) for i in report.unexplained_intervals),
        steps=tuple(dataclasses.replace(step, put_in=(text,), dropped=(text,)) for step in report.steps),
        stop_test=text,
        trace=dataclasses.replace(report.trace, names=names, units=(text,) * len(names)),
    )
