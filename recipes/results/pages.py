"""The tables of the pages in this folder, each a function from the stored records, by table, to Markdown."""

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from statistics import mean, stdev
from typing import Any

import pandas as pd
import yaml
from scipy.stats import binomtest

from torchrl_h2o.comparison.markdown import markdown_table
from torchrl_h2o.comparison.records import Record
from torchrl_h2o.comparison.results_file import IDENTITY
from torchrl_h2o.comparison.seed_table import seed_tables

HERE = Path(__file__).parent
NOT_RUN = "not run on this code"
CLOSE = 0.25  # relative error up to which a value counts as right
WHOLE_EPISODE = 30.0  # s, an episode of the robot without a fall
#: values that make a training another line of the table
SETTINGS = (*(key for key in IDENTITY if key != "seed"), "compiled", "device")
Records = Mapping[str, Sequence[Record]]  # by table


@cache
def machines() -> dict[str, dict[str, Any]]:
    return yaml.safe_load((HERE / "machines.yaml").read_text())


@cache
def drawn_families() -> dict[str, dict[str, Any]]:
    return yaml.safe_load((HERE / "drawn.yaml").read_text())


def share(right: int, of: int) -> str:
    """A number of cases with the 95 % interval of Wilson of their share.

    Example:
        >>> share(9, 10)
        '9 of 10 [60, 98 %]'
    """
    if not of:
        return ""
    low, high = binomtest(right, of).proportion_ci(method="wilson")
    return f"{right} of {of} [{100 * low:.0f}, {100 * high:.0f} %]"


def number(value: float) -> str:
    return f"{value:.3g}"


def minutes(records: Iterable[Record]) -> str:
    return number(sum(record.made_by["cpu_s"] for record in records) / 60)


def commit(record: Record) -> str:
    return record.made_by["commit"] or "unknown"


# What it finds
def machines_table(records: Records) -> str:
    """A line for each known value of each machine, with what its report says."""
    found = {record.name: record for record in records.get("machines", ())}
    head = ["machine", "known", "found [95 % interval]", "verdict", "CPU min", "commit", "set with this log"]
    rows = []
    for name, machine in machines().items():
        told = [f"{known['what']} {_value(known)} ({known['by']})" for known in machine["known"]]
        if name not in found:
            rows.append([machine["machine"], "; ".join(told) or "nothing", NOT_RUN, "", "", "", _yes(machine)])
            continue
        record = found[name]
        effects = record.values["effects"]
        lines = [[words, _found(effects, known)] for words, known in zip(told, machine["known"], strict=True)]
        if others := _not_known(effects, machine["known"]):
            lines.append(["*besides*" if lines else "nothing", others])
        first, *rest = lines or [["nothing", "nothing"]]
        rows.append(
            [machine["machine"], *first, verdict(record.values), minutes([record]), commit(record), _yes(machine)]
        )
        rows += [["", *line, "", "", "", ""] for line in rest]
    return markdown_table(head, rows)


def _yes(machine: Mapping) -> str:
    return "yes" if machine["set_with"] else "no"


def _value(known: Mapping) -> str:
    return f"× {known['value']}" if known["unit"] == "×" else f"{known['value']} {known['unit']}"


def verdict(values: Mapping) -> str:
    """The verdict of a report, in a few words."""
    if values["severe"]:
        return f"stopped by the audit: {values['severe'][0]}"
    parts = [str(values["verdict"]).replace("_", " ")]
    if values["effects"] and not values["recommended"]:
        parts.append("not recommended")
    if values["other_sets"]:
        parts.append(f"{values['other_sets']} other sets explain the log as well")
    if values["ended_in"]:
        parts.append("time was up")
    return "; ".join(parts)


def _matching(effects: Iterable[Mapping], known: Mapping) -> list[Mapping]:
    """The effects of a report that act where a known value does."""
    return [
        effect
        for effect in effects
        if effect["effect"]["effect"] == known.get("effect")
        and ("on" not in known or any(fnmatch(str(known["on"]), name) for name in _selected(effect["effect"])))
    ]


def _selected(effect: Mapping) -> list[str]:
    chosen = [value for key, value in effect.items() if key != "effect" and isinstance(value, str | list)]
    return [str(name) for value in chosen for name in (value if isinstance(value, list) else [value])]


def _found(effects: Iterable[Mapping], known: Mapping) -> str:
    if "effect" not in known:
        return "not compared"
    parameters = [_parameter(effect, known) for effect in _matching(effects, known)]
    if not parameters:
        return "not found"
    values = [parameter["value"] for parameter in parameters]
    value = math.prod(values) if known["unit"] == "×" else sum(values)
    interval = parameters[0]["ci95"] if len(parameters) == 1 else None
    error = abs(abs(value) / abs(known["value"]) - 1.0)
    words = f"{number(value)}" + (f" [{number(interval[0])}, {number(interval[1])}]" if interval else "")
    return f"{words}: {'right' if error <= CLOSE else '**wrong**'}, {100 * error:.0f} % off"


def _parameter(effect: Mapping, known: Mapping) -> Mapping:
    parameters = effect["parameters"]
    return parameters[known.get("parameter", next(iter(parameters)))]


def _not_known(effects: Sequence[Mapping], known: Iterable[Mapping]) -> str:
    compared = [effect for entry in known for effect in _matching(effects, entry)]
    return "; ".join(effect["words"] for effect in effects if effect not in compared)


def sources_table(records: Records) -> str:
    rows = [[entry["machine"], entry["source"], f"`{c}`" if (c := entry.get("command")) else ""]
            for entry in machines().values()]  # fmt: skip
    return markdown_table(["machine", "source of the log", "command"], rows)


# How often it is right
def _chose(record: Record) -> bool:
    """Whether something was chosen with this draw; draws of other seeds are always held back."""
    values = record.values
    return values["seed"] == 0 and values["number"] in drawn_families()[values["family"]]["chose"]


def drawn_table(records: Records) -> str:
    """A line for each family: draws that chose something and draws held back, apart."""
    by_family = defaultdict(list)
    for record in records.get("drawn", ()):
        by_family[record.values["family"]].append(record)
    head = [
        "family",
        "right is",
        "draws held back",
        "draws that chose something",
        "not run",
        "CPU min a draw",
        "commit",
    ]
    rows = []
    for name, family in drawn_families().items():
        own = by_family.get(name, [])
        chose = [record for record in own if _chose(record)]
        held = [r for r in own if r not in chose]
        counts = [share(sum(r.values["ok"] for r in part), len(part)) for part in (held, chose)]
        left = family["draws"] - len({r.values["number"] for r in own if r.values["seed"] == 0})
        last = [number(float(minutes(own)) / len(own)), commit(own[0])] if own else ["", ""]
        rows.append([f"`{name}`", family["right"], *(counts if own else [NOT_RUN, ""]), str(left or ""), *last])
    return markdown_table(head, rows)


def audit_table(records: Records) -> str:
    head = ["logs", "right", "refused by the reader", "CPU s of the longest audit", "commit"]
    rows = []
    for r in records.get("audit", ()):
        values, refused = r.values, r.values["refused"] or ""
        cells = [r.name.replace("_", " "), share(values["right"], values["logs"]), str(refused)]
        rows.append([*cells, number(values["longest_cpu_s"]), commit(r)])
    return markdown_table(head, rows or [["damaged and good logs", NOT_RUN, "", "", ""]])


# Where it fails
def failures_table(records: Records) -> str:
    """All draws and logs of the tables above that are wrong, with what was found."""
    rows = []
    for values in [record.values for record in records.get("drawn", ()) if not record.values["ok"]]:
        case = f"`{values['family']}` {values['number']}, {values['name']}"
        rows.append([case, values["truth"], values["found"], str(values.get("verdict", ""))])
    for record in records.get("machines", ()):
        for known in machines()[record.name]["known"]:
            found = _found(record.values["effects"], known)
            if "wrong" in found or found == "not found":
                told = f"{known['what']} {_value(known)}"
                rows.append([machines()[record.name]["machine"], told, found, verdict(record.values)])
    for record in records.get("audit", ()):
        rows += [[record.name.replace("_", " "), *wrong.partition(": ")[::2], ""] for wrong in record.values["wrong"]]
    number_of_cases = sum(len(records.get(table, ())) for table in ("drawn", "machines", "audit"))
    return markdown_table(["case", "true", "found", "verdict"], rows or [[f"none of {number_of_cases}", "", "", ""]])


# Training
def _groups(records: Records) -> dict[tuple, list[Record]]:
    groups = defaultdict(list)
    for record in records.get("training", ()):
        processor = record.made_by["instruction_set"]
        groups[(*(str(record.values[key]) for key in SETTINGS), processor)].append(record)
    return dict(sorted(groups.items()))


def training_table(records: Records) -> str:
    """A line for each task, method and settings: seeds that stand, return, distance."""
    head = ["task", "method and settings", "processor", "whole episodes", "return", "data's return", "farthest, m"]
    rows = []
    for key, own in _groups(records).items():
        told, values = dict(zip(SETTINGS, key, strict=False)), [record.values for record in own]
        shown = ("data", "data_seconds", "gap", "mend", "updates", "others")
        settings = [f"{name} {told[name]}" for name in shown if told[name] not in ("", "recorded")]
        stands = sum(float(run["seconds"] or 0) >= WHOLE_EPISODE for run in values)
        whole = share(stands, len(own)) if told["env"].startswith("wheel_legged") else f"{len(own)} seeds"
        ended = [run for run in values if run["return_mean"] != ""]
        returns = [float(run["return_mean"]) for run in ended]
        spread = f" ± {stdev(returns):,.0f}" if len(returns) > 1 else ""
        far = [f"{float(run['max_abs_x']):.2f}" for run in ended if run["max_abs_x"] != ""]
        method = "; ".join([told["method"], *settings])
        processor = f"{told['device']} {key[-1]}, compiled={told['compiled']}"
        found = f"{mean(returns):,.0f}{spread}" if returns else "diverged"
        of_data = f"{float(ended[0]['return_data']):,.0f}" if ended else ""
        cost = number(float(minutes(own)) / len(own))
        rows.append([told["env"], method, processor, whole, found, of_data, max(far, default=""), cost, commit(own[0])])
    empty = ["wheel_legged/standing_still", "h2o_plus", "", NOT_RUN, *[""] * 5]
    return markdown_table([*head, "CPU min a run", "commit"], rows or [empty])


def by_seed_table(records: Records) -> str:
    rows = [
        {key: str(value) for key, value in record.values.items()} | {"others": _others(record)}
        for record in records.get("training", ())
        if record.values["env"].startswith("wheel_legged")
    ]
    return seed_tables(pd.DataFrame(rows)) if rows else NOT_RUN


def _others(record: Record) -> str:
    told = [record.values["others"], f"compiled={record.values['compiled']}", record.made_by["instruction_set"]]
    return " ".join(filter(None, told))


def speed_table(records: Records) -> str:
    rows = [
        [record.values["device"], name, f"{rate:,.1f}", commit(record)]
        for record in records.get("speed", ())
        for name, rate in record.values["updates_per_second"].items()
    ]
    return markdown_table(["device", "what", "updates per second", "commit"], rows or [["", "H2O+", NOT_RUN, ""]])


def ratio_table(records: Records) -> str:
    groups = defaultdict(list)
    for record in records.get("ratio", ()):
        groups[tuple(str(record.values[key]) for key in ("system", "estimator", "rows", "steps"))].append(record)
    shown = ("unclamped", "clamped", "ess", "accuracy", "correlation", "slope")
    rows = []
    for key, own in sorted(groups.items()):
        values = [[r.values[name] for r in own if name in r.values] for name in shown]
        rows.append(
            [*key, *(f"{mean(column):.2f}" if column else "" for column in values), str(len(own)), commit(own[0])]
        )
    head = ["system", "estimator", "simulated rows", "updates", "mean ratio", "clamped", "effective share", "accuracy",
            "correlation", "slope", "seeds", "commit"]  # fmt: skip
    return markdown_table(head, rows or [["", "", "", "", NOT_RUN, *[""] * 7]])


# The overview
def overview_table(records: Records) -> str:
    drawn = records.get("drawn", ())
    held = [record.values["ok"] for record in drawn if not _chose(record)]
    of_robot = [r.values for r in records.get("training", ()) if r.values["env"].startswith("wheel_legged")]
    stands = [float(values["seconds"] or 0) >= WHOLE_EPISODE for values in of_robot]
    wrong = sum(not record.values["ok"] for record in drawn)
    rows = [
        [
            "machines",
            "what it finds in logs of machines",
            f"{len(records.get('machines', ()))} of {len(machines())} run",
        ],
        ["drawn", "how often it is right", f"{share(sum(held), len(held))} draws held back" if held else NOT_RUN],
        ["failures", "where it fails", f"{wrong} of {len(drawn)} draws"],
        ["training", "training", f"robot stands in {share(sum(stands), len(stands))} runs" if stands else NOT_RUN],
    ]
    return markdown_table(
        ["page", "what is in it", "now"], [[f"[{page}.md]({page}.md)", *rest] for page, *rest in rows]
    )


TABLES: dict[str, Callable[[Records], str]] = {
    "overview": overview_table,
    "machines": machines_table,
    "sources": sources_table,
    "drawn": drawn_table,
    "audit": audit_table,
    "failures": failures_table,
    "training": training_table,
    "by_seed": by_seed_table,
    "speed": speed_table,
    "ratio": ratio_table,
}
