"""Writes and reads ``report.json``: strict JSON in which numbers that are not finite are null."""

import dataclasses
import json
import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import ConfigDict, TypeAdapter, ValidationError, with_config

from torchrl_h2o.data.audit import Audit
from torchrl_h2o.data.readers.error import DataError
from torchrl_h2o.effects import Effect, effect_from_dict, effect_to_dict
from torchrl_h2o.residuals.between_logs import InLogs
from torchrl_h2o.residuals.report.contents import (
    DataSummary,
    FoundEffect,
    IndistinguishableGroup,
    Interval,
    OtherExplanation,
    RejectedEffect,
    ReportContents,
    SearchStep,
    Verdict,
)
from torchrl_h2o.residuals.report.errors import (
    DimensionError,
    ErrorSummary,
    HeadlineError,
    HorizonError,
    PredictedRow,
    Prediction,
    PredictionTable,
)
from torchrl_h2o.residuals.report.mended_model import REMEDY, LeftOut, MendedModel
from torchrl_h2o.residuals.report.residual_trace import ResidualTrace
from torchrl_h2o.residuals.report.sentence import sentence
from torchrl_h2o.residuals.report.windows import RunError, ShownWindow, WindowQuantity
from torchrl_h2o.residuals.report.words import effect_name
from torchrl_h2o.whole_file import write_text

FILE = "report.json"
_ARRAYS = ("before", "after", "states")
Read = TypeVar("Read", bound=ReportContents)


def write_json(report: ReportContents, folder: str | Path) -> Path:
    """Writes ``report.json`` into a folder, which is created if it does not exist, and returns the file's path."""
    text = json.dumps(report_to_json(report), ensure_ascii=False, allow_nan=False, indent=1)
    return write_text(Path(folder) / FILE, text + "\n")


def read_json(path: str | Path, build: Callable[[Mapping[str, Any]], Read]) -> Read:
    """Reads a report from its file, or from the folder that contains it.

    Args:
        path: of the file or the folder.
        build: makes a report from the entries of the file.

    Raises:
        DataError: if there is no such file, or it is not a report.
    """
    path = Path(path)
    path = path / FILE if path.is_dir() else path
    remedy = "give the report.json that Report.save wrote, or its folder"
    try:
        read = build(json.loads(path.read_text(encoding="utf-8")))
        # an entry of a wrong type would otherwise show itself only where it is used
        _types_of(type(read)).validate_python(read, strict=True)
        json.dumps(report_to_json(read), allow_nan=False)
        return read
    except OSError as error:
        raise DataError(f"cannot be read ({error.strerror})", remedy, source=path) from error
    except KeyError as error:
        raise DataError(f"is not a report: it lacks {error}", remedy, source=path) from error
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where, problem = ".".join(map(str, first["loc"])), f"{first['msg']}, not {str(first['input'])[:50]!r}"
        raise DataError(f"is not a report: {where}: {problem}", remedy, source=path) from error
    except Exception as error:  # whatever it is that fails with entries of wrong types
        raise DataError(f"is not a report: {error}", remedy, source=path) from error


@cache
def _types_of(report: type) -> TypeAdapter:
    """Checks the types of all entries of a report."""
    allowed = ConfigDict(arbitrary_types_allowed=True, revalidate_instances="always", defer_build=False)
    return TypeAdapter(with_config(allowed)(report))


def report_to_json(report: ReportContents) -> dict[str, Any]:
    """The entries of the file."""
    return _plain(
        {
            "sentence": sentence(report),
            "simulator": report.simulator,
            "effects": [_effect_to_json(found.effect, found) for found in report.found],
            "rejected": [_effect_to_json(rejected.effect, rejected) for rejected in report.rejected],
            "indistinguishable": [
                {
                    "effects": [
                        {
                            "name": effect_name(effect),
                            "words": words,
                            "error": error,
                            "effect": effect_to_dict(effect),
                            "together": [{"ci95": ci95, "effect": effect_to_dict(other)} for other, ci95 in together],
                        }
                        for effect, error, words, together in zip(
                            group.effects, group.errors, group.words, group.together, strict=True
                        )
                    ],
                }
                for group in report.indistinguishable
            ],
            "error": None if report.error is None else dataclasses.asdict(report.error),
            "verdict": None if report.verdict is None else dataclasses.asdict(report.verdict),
            "others": [
                {
                    "effects": [effect_to_dict(effect) for effect in other.effects],
                    "words": other.words,
                    "error": other.error,
                }
                for other in report.others
            ],
            "failures": report.failures,
            "audit": None if report.audit is None else report.audit.to_dict(),
            "unfinished": report.unfinished,
            "ended_in": report.ended_in,
            "left_out": report.left_out,
            "predictions": None if report.predictions is None else dataclasses.asdict(report.predictions),
            "unexplained_intervals": [dataclasses.asdict(interval) for interval in report.unexplained_intervals],
            "data": dataclasses.asdict(report.data),
            "steps": [dataclasses.asdict(step) for step in report.steps],
            "stop_test": report.stop_test,
            "conclusion": report.conclusion,
            "wall_s": report.wall_s,
            "made_by": report.made_by,
            "windows": [dataclasses.asdict(window) for window in report.windows],
            "runs": [dataclasses.asdict(run) for run in report.runs],
            "mended_model": None if report.mended_model is None else _mended_to_json(report.mended_model),
            "trace": None if report.trace is None else _trace_to_json(report.trace),
        }
    )


def entries_from_json(entries: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a report by name, from the entries that :func:`report_to_json` returned.

    Raises:
        KeyError, TypeError, ValueError, AttributeError, IndexError: if the entries are not those of a report.
    """
    return {
        "simulator": entries["simulator"],
        "found": tuple(_found(entry) for entry in entries["effects"]),
        "rejected": tuple(
            _read(RejectedEffect, entry, effect=effect_from_dict(entry["effect"]), units=_units(entry))
            for entry in entries["rejected"]
        ),
        "indistinguishable": tuple(_group(entry) for entry in entries["indistinguishable"]),
        "error": None if entries["error"] is None else _error(entries["error"]),
        "verdict": None if entries.get("verdict") is None else _verdict(entries["verdict"]),
        "others": tuple(_other(entry) for entry in entries.get("others", ())),
        "failures": tuple(entries.get("failures", ())),
        "audit": None if entries.get("audit") is None else Audit.from_dict(entries["audit"]),
        "unfinished": entries.get("unfinished"),
        "ended_in": entries.get("ended_in"),
        "left_out": tuple(entries.get("left_out", ())),
        "predictions": None if entries.get("predictions") is None else _predictions(entries["predictions"]),
        "unexplained_intervals": tuple(_read(Interval, entry) for entry in entries["unexplained_intervals"]),
        "data": _read(DataSummary, entries["data"]),
        "steps": tuple(_step(entry) for entry in entries.get("steps", ())),
        "stop_test": entries["stop_test"],
        "conclusion": entries["conclusion"],
        "wall_s": entries["wall_s"],
        "made_by": entries.get("made_by", {}),
        # not in files of earlier versions
        "windows": tuple(_window(entry) for entry in entries.get("windows", ())),
        "runs": tuple(_read(RunError, entry) for entry in entries.get("runs", ())),
        "mended_model": _mended(entries.get("mended_model")),
        "trace": None if entries["trace"] is None else _trace(entries["trace"]),
    }


def _effect_to_json(effect: Effect, tried: FoundEffect | RejectedEffect) -> dict[str, Any]:
    """An effect with its description, its parameters, its errors, and the entry that rebuilds it."""
    rest = {field.name: getattr(tried, field.name) for field in dataclasses.fields(tried)}
    ci95, units, in_logs = rest.pop("ci95", {}), rest.pop("units"), rest.pop("in_logs", {})
    return {
        "name": effect_name(effect),
        "parameters": {
            name: {
                "value": parameter.value,
                "unit": units.get(name, parameter.unit),
                "ci95": ci95.get(name),
                **({"in_logs": dataclasses.asdict(in_logs[name])} if name in in_logs else {}),
            }
            for name, parameter in effect.parameters.items()
        },
        **rest,
        "effect": effect_to_dict(effect),
    }


def _trace_to_json(trace: ResidualTrace) -> dict[str, Any]:
    """The trace, thinned and rounded to six digits, because it is used for pictures only."""
    trace = trace.thinned()
    arrays = {name: [_rounded(row) for row in getattr(trace, name)] for name in _ARRAYS}
    return {
        "time": _rounded(trace.time),
        "names": trace.names,
        "units": trace.units,
        **arrays,
        "held_out": trace.held_out,
    }


def _rounded(row: np.ndarray) -> list[float]:
    return [float(f"{value:.6g}") for value in row]


def _plain(value: Any) -> Any:
    """A value in JSON's types: arrays become lists, NumPy numbers Python numbers, and non-finite numbers None."""
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _float(value: float | None) -> float:
    return math.nan if value is None else value


def _floats(entries: Mapping[str, float | None]) -> dict[str, float]:
    return {name: _float(value) for name, value in entries.items()}


def _read(cls: type, entry: Mapping[str, Any], **read: Any) -> Any:
    """Builds a dataclass instance from converted fields and, for the other fields, from the entry's values.

    Fields with a default may be missing, as in files of earlier versions.
    """
    there = {**entry, **read}
    values = {}
    for field in dataclasses.fields(cls):
        if field.name in there or field.default is dataclasses.MISSING:
            values[field.name] = there[field.name]
    floats = {field.name for field in dataclasses.fields(cls) if field.type is float}
    return cls(**{name: _float(value) if name in floats else value for name, value in values.items()})


def _found(entry: Mapping[str, Any]) -> FoundEffect:
    effect = effect_from_dict(entry["effect"])
    ci95 = _intervals({name: parameter["ci95"] for name, parameter in entry["parameters"].items()})
    in_logs = {name: _in_logs(one["in_logs"]) for name, one in entry["parameters"].items() if "in_logs" in one}
    return _read(FoundEffect, entry, effect=effect, ci95=ci95, units=_units(entry), in_logs=in_logs)


def _in_logs(entry: Mapping[str, Any]) -> InLogs:
    """A value in each log; an error of None is infinite, because the log does not contain the value."""
    errors = tuple(math.inf if error is None else error for error in entry["errors"])
    return _read(InLogs, entry, logs=tuple(entry["logs"]), values=tuple(map(_float, entry["values"])), errors=errors)


def _units(entry: Mapping[str, Any]) -> dict[str, str]:
    return {name: parameter["unit"] for name, parameter in entry["parameters"].items()}


def _intervals(entries: Mapping[str, Sequence[float | None] | None]) -> dict[str, tuple[float, float]]:
    return {name: (_float(ends[0]), _float(ends[1])) for name, ends in entries.items() if ends is not None}


def _group(entry: Mapping[str, Any]) -> IndistinguishableGroup:
    members = entry["effects"]
    return IndistinguishableGroup(
        effects=tuple(effect_from_dict(member["effect"]) for member in members),
        errors=tuple(_float(member["error"]) for member in members),
        words=tuple(member["words"] for member in members if "words" in member),
        together=tuple(
            tuple((effect_from_dict(other["effect"]), _intervals(other["ci95"])) for other in member["together"])
            for member in members
            if "together" in member  # not in files of earlier versions
        ),
    )


def _error(entry: Mapping[str, Any]) -> ErrorSummary:
    horizons = tuple(
        _read(HorizonError, horizon, before=_floats(horizon["before"]), after=_floats(horizon["after"]))
        for horizon in entry["horizons"]
    )
    per_dimension = tuple(_read(DimensionError, dimension) for dimension in entry["per_dimension"])
    headline = None if entry.get("headline") is None else _read(HeadlineError, entry["headline"])
    return _read(ErrorSummary, entry, per_dimension=per_dimension, horizons=horizons, headline=headline)


def _other(entry: Mapping[str, Any]) -> OtherExplanation:
    effects = tuple(map(effect_from_dict, entry["effects"]))
    return _read(OtherExplanation, entry, effects=effects, words=tuple(entry["words"]))


def _verdict(entry: Mapping[str, Any]) -> Verdict:
    lists = {name: tuple(entry.get(name, ())) for name in ("reasons", "caveats", "undetectable")}
    return _read(Verdict, entry, **lists)


def _step(entry: Mapping[str, Any]) -> SearchStep:
    return _read(SearchStep, entry, put_in=tuple(entry["put_in"]), dropped=tuple(entry["dropped"]))


def _predictions(entry: Mapping[str, Any]) -> PredictionTable:
    rows = (
        PredictedRow(row["name"], **{name: _read(Prediction, cell) for name, cell in row.items() if name != "name"})
        for row in entry["rows"]
    )
    return PredictionTable(entry["seconds"], tuple(rows))


def _window(entry: Mapping[str, Any]) -> ShownWindow:
    quantities = tuple(
        WindowQuantity(
            quantity["name"],
            quantity["unit"],
            *(tuple(map(_float, quantity[name])) for name in ("measured", "before", "after")),
        )
        for quantity in entry["quantities"]
    )
    return _read(ShownWindow, entry, ahead=tuple(entry["ahead"]), quantities=quantities)


def _mended_to_json(mended: MendedModel) -> dict[str, Any]:
    """The entries of mended.xml: its name, and each effect that it does not contain, with the reason."""
    return {
        "file": mended.file,
        "failure": mended.failure,
        "left_out": [
            {"name": effect_name(left.effect), "words": left.words, "reason": left.reason}
            | {"effect": effect_to_dict(left.effect)}
            for left in mended.left_out
        ],
        "remedy": REMEDY if mended.left_out else None,
    }


def _mended(entry: Mapping[str, Any] | None) -> MendedModel | None:
    if entry is None:
        return None
    left_out = (LeftOut(effect_from_dict(left["effect"]), left["reason"], left["words"]) for left in entry["left_out"])
    return MendedModel(entry["file"], tuple(left_out), entry["failure"])


def _trace(entry: Mapping[str, Any]) -> ResidualTrace:
    arrays = {name: np.array(entry[name], dtype=float).reshape(-1, len(entry["names"])) for name in _ARRAYS}
    return ResidualTrace(
        time=np.array(entry["time"], dtype=float),
        names=tuple(entry["names"]),
        units=tuple(entry["units"]),
        held_out=np.array(entry["held_out"], dtype=bool),
        **arrays,
    )
