"""Prints the benchmark's results: cases passed and expected, failures and speed."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from cases import Family


def table(families: Mapping[str, Family], rows: Sequence[dict]) -> str:
    """Format one line a family: cases passed, cases expected to pass, and the criterion."""
    lines = [f"{'cases':<18}{'reached':>10}{'asked':>10}  of each"]
    for name, family in families.items():
        passed = [row["ok"] for row in rows if row["family"] == name]
        reached, asked = f"{sum(passed)} of {len(passed)}", f"{family.asked} of {family.size}"
        lines.append(f"{name:<18}{reached:>10}{asked:>10}  {family.what}")
    return "\n".join(lines)


def print_table(families: Mapping[str, Family], rows: Sequence[dict], directory: Path) -> None:
    """Print the table, the failed cases and the paths of the result files."""
    print(f"\n{table(families, rows)}")
    missed = [row for row in rows if not row["ok"]]
    if missed:
        print("\nmissed")
    for row in missed:
        name = row.get("name", "")
        print(f"  {row['family']} {row['number']}  {name}: {row.get('truth', '')} -> {row['found']}")
    print(f"\nresults    {os.path.relpath(directory)}/results.json, results.csv, reports/")


def print_speed(rows: Sequence[dict], rates: Mapping[str, float], processes: int) -> None:
    """Print control steps a second in tracing and in isolation, relative to ``mujoco.rollout``."""
    traced = [row for row in rows if row.get("system") == "HalfCheetah"]
    if traced:
        simulated = sum(row["steps"] for row in traced) / sum(row["simulating_s"] for row in traced)
        rates = {f"in tracing, {processes} at once": simulated, **rates}
    print("speed      HalfCheetah, control steps a second")
    for name, rate in rates.items():
        print(f"           {name:<24}{rate:>10,.0f}{rate / rates['mujoco.rollout']:>8.0%}")
    if traced:
        seconds = [row["wall_s"] for row in traced]
        print(f"           a case took {sum(seconds) / len(seconds):.0f} s on average, {max(seconds):.0f} s at most")
