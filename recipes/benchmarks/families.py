"""The families of cases by name, one line of the benchmark's table each."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType

from cases import Family
from drawn_cases import DECOY, JOINT_BY_JOINT, NOISY_TORQUES, NOTHING, SEVERAL, SLOW, UNDECLARED_FORCE
from log_cases import log_families
from machine_cases import MACHINE
from paper_cases import PAPER, PAPER_WITH_NOISE
from robot_cases import ROBOT

FAMILIES: Mapping[str, Family] = MappingProxyType(
    {
        "paper16": PAPER,
        "paper16_noise": PAPER_WITH_NOISE,
        "several": SEVERAL,
        "undeclared": UNDECLARED_FORCE,
        "nothing": NOTHING,
        "decoy": DECOY,
        "slow": SLOW,
        "joints": JOINT_BY_JOINT,
        "torques": NOISY_TORQUES,
        "robot": ROBOT,
        "machines": MACHINE,
    }
)


def all_families(logs: Path | None = None) -> dict[str, Family]:
    """All families, including those of the real logs if their folder is given."""
    return {**FAMILIES, **(log_families(logs) if logs is not None else {})}


def choose_families(names: Iterable[str], logs: Path | None = None) -> dict[str, Family]:
    """Select families by name. If ``logs`` is given and no family of it is named, all of its families are added.

    Raises:
        ValueError: for an unknown name.
        FileNotFoundError: if the folder does not exist.
    """
    if logs is not None and not logs.is_dir():
        raise FileNotFoundError(f"logs={logs}: there is no such folder")
    there = all_families(logs)
    names, logged = list(names), there.keys() - FAMILIES.keys()
    if logged.isdisjoint(names):
        names += logged
    for name in names:
        if name not in there:
            raise ValueError(f"cases={name}: choose from {', '.join(there)}")
    return {name: family for name, family in there.items() if name in names}
