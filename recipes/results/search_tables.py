"""Tables of searches: what they find in logs of machines and in drawn cases, where they fail, and their intervals."""

import math
from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatch

import pandas as pd
from cells import NOT_RUN, Runs, drawn_families, machines, number, share

from torchrl_h2o.comparison.markdown import markdown_table

CLOSE = 0.25  # relative error up to which a value counts as right


# What it finds
def machines_table(runs: Runs) -> str:
    """A line for each known value of each machine, with what its report says."""
    found = {row["run"]: row for row in runs["machines"].to_dict("records")} if "machines" in runs else {}
    head = ["machine", "known", "found [95 % interval]", "verdict", "CPU min", "commit", "set with this log"]
    rows = []
    for name, machine in machines().items():
        told = [f"{known['what']} {_value(known)} ({known['by']})" for known in machine["known"]]
        set_with = "yes" if machine["set_with"] else "no"
        if name not in found:
            rows.append([machine["machine"], "; ".join(told) or "nothing", NOT_RUN, "", "", "", set_with])
            continue
        run = found[name]
        lines = [[words, _found(run["effects"], known)] for words, known in zip(told, machine["known"], strict=True)]
        if others := _not_known(run["effects"], machine["known"]):
            lines.append(["*besides*" if lines else "nothing", others])
        first, *rest = lines or [["nothing", "nothing"]]
        rows.append([machine["machine"], *first, verdict(run), number(run["minutes"]), run["commit"], set_with])
        rows += [["", *line, "", "", "", ""] for line in rest]
    return markdown_table(head, rows)


def _value(known: Mapping) -> str:
    return f"× {known['value']}" if known["unit"] == "×" else f"{known['value']} {known['unit']}"


def verdict(run: Mapping) -> str:
    """The verdict of a report, in a few words."""
    if run["severe"]:
        return f"severe finding of the audit: {run['severe'][0]}"
    parts = [str(run["verdict"]).replace("_", " ")]
    if run["effects"] and not run["recommended"]:
        parts.append("not recommended")
    if run["other_sets"]:
        parts.append(f"{run['other_sets']} other sets explain the log as well")
    return "; ".join([*parts, *(["time was up"] if run["ended_in"] else [])])


def _matching(effects: Iterable[Mapping], known: Mapping) -> list[Mapping]:
    """The effects of a report that act where a known value does."""

    def acts(effect: Mapping) -> bool:
        chosen = [value for key, value in effect.items() if key != "effect" and isinstance(value, str | list)]
        names = [name for value in chosen for name in ([value] if isinstance(value, str) else value)]
        return "on" not in known or any(fnmatch(str(known["on"]), str(name)) for name in names)

    return [each for each in effects if each["effect"]["effect"] == known.get("effect") and acts(each["effect"])]


def _found(effects: Iterable[Mapping], known: Mapping) -> str:
    if "effect" not in known:
        return "not compared"
    found = [effect["parameters"] for effect in _matching(effects, known)]
    parameters = [entries[known.get("parameter", next(iter(entries)))] for entries in found]
    if not parameters:
        return "not found"
    values = [parameter["value"] for parameter in parameters]
    value = math.prod(values) if known["unit"] == "×" else sum(values)
    interval = parameters[0]["ci95"] if len(parameters) == 1 else None
    error = abs(abs(value) / abs(known["value"]) - 1.0)
    words = number(value) + (f" [{number(interval[0])}, {number(interval[1])}]" if interval else "")
    return f"{words}: {'right' if error <= CLOSE else '**wrong**'}, {100 * error:.0f} % off"


def _not_known(effects: Sequence[Mapping], known: Iterable[Mapping]) -> str:
    compared = [effect for entry in known for effect in _matching(effects, entry)]
    return "; ".join(effect["words"] for effect in effects if effect not in compared)


def sources_table(runs: Runs) -> str:
    told = [(entry, entry.get("command")) for entry in machines().values()]
    rows = [[entry["machine"], entry["source"], f"`{command}`" if command else ""] for entry, command in told]
    return markdown_table(["machine", "source of the log", "command"], rows)


# How often it is right
def draws_of(runs: Runs) -> pd.DataFrame:
    """All drawn cases, with the column ``held``: whether nothing was chosen with them, as with all of other seeds."""
    draws = runs.get("drawn", pd.DataFrame(columns=["family", "number", "seed", "ok"]))
    chose = {(family, 0, draw) for family, told in drawn_families().items() for draw in told["chose"]}
    keys = draws[["family", "seed", "number"]].itertuples(index=False, name=None)
    return draws.assign(held=[key not in chose for key in keys])


def drawn_table(runs: Runs) -> str:
    """A line for each family: draws that chose something and draws held back, apart."""
    head = [
        "family",
        "right is",
        "draws held back",
        "draws that chose something",
        "not run",
        "CPU min a draw",
        "commit",
    ]
    rows, draws = [], draws_of(runs)
    for name, family in drawn_families().items():
        own = draws[draws["family"] == name]
        held, chose = own.loc[own["held"], "ok"], own.loc[~own["held"].astype(bool), "ok"]
        counts, cost, commit = [NOT_RUN, ""], "", ""
        if len(own):
            counts = [share(part.sum(), len(part)) for part in (held, chose)]
            cost, commit = number(own["minutes"].mean()), own["commit"].iloc[0]
        left = family["draws"] - own.loc[own["seed"] == 0, "number"].nunique()
        rows.append([f"`{name}`", family["right"], *counts, str(left or ""), cost, commit])
    return markdown_table(head, rows)


def audit_table(runs: Runs) -> str:
    head = ["logs", "right", "refused by the reader", "CPU s of the longest audit", "commit"]
    rows = [
        [run["run"].replace("_", " "), share(run["right"], run["logs"]), str(run["refused"] or ""),
         number(run["longest_cpu_s"]), run["commit"]]
        for run in (runs["audit"].to_dict("records") if "audit" in runs else ())
    ]  # fmt: skip
    return markdown_table(head, rows or [["damaged and good logs", NOT_RUN, "", "", ""]])


# Where it fails
def failures_table(runs: Runs) -> str:
    """All draws and logs of the tables above that are wrong, with what was found."""
    draws = draws_of(runs)
    rows = [
        [
            f"`{draw['family']}` {draw['number']}, {draw['name']}",
            draw["truth"],
            draw["found"],
            str(draw.get("verdict", "")),
        ]
        for draw in draws[~draws["ok"].astype(bool)].to_dict("records")
    ]
    for run in runs["machines"].to_dict("records") if "machines" in runs else ():
        for known in machines()[run["run"]]["known"]:
            found = _found(run["effects"], known)
            if "wrong" in found or found == "not found":
                told = f"{known['what']} {_value(known)}"
                rows.append([machines()[run["run"]]["machine"], told, found, verdict(run)])
    for run in runs["audit"].to_dict("records") if "audit" in runs else ():
        rows += [[run["run"].replace("_", " "), *wrong.partition(": ")[::2], ""] for wrong in run["wrong"]]
    cases = sum(len(runs[table]) for table in ("drawn", "machines", "audit") if table in runs)
    return markdown_table(["case", "true", "found", "verdict"], rows or [[f"none of {cases}", "", "", ""]])


# Whether its intervals are right
def coverage_table(runs: Runs) -> str:
    """A line for each machine: values of logs that were left out, inside the intervals that its other logs gave."""
    head = [
        "machine",
        "series",
        "values compared",
        "inside",
        "inside, with the log's own interval",
        "true value inside",
    ]
    rows = []
    for machine, own in runs["coverage"].groupby("machine", sort=False) if "coverage" in runs else ():
        sums = own[["asked", "values", "inside", "inside_widened", "truths", "truths_inside"]].sum()
        shares = [share(sums[key], sums["values"]) for key in ("inside", "inside_widened")]
        counted = [str(len(own)), f"{sums['values']} of {sums['asked']}", *shares]
        last = [number(own["minutes"].mean()), own["commit"].iloc[0]]
        rows.append([machine, *counted, share(sums["truths_inside"], sums["truths"]), *last])
    return markdown_table([*head, "CPU min a series", "commit"], rows or [["", "", NOT_RUN, *[""] * 5]])
