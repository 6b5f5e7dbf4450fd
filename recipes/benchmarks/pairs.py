"""Pairs of a right and a wrong set of effects for a log, with which a score is tested: it must prefer the right one.

The pairs stand in pairs.yaml. Most are of simulated cases, which are recorded again when they are needed; those of
measured logs need the folder of the logs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import undeclared_effects  # noqa: F401  (its effects are named in pairs.yaml)
import yaml
from cases import Case, draw_case
from running import FAMILIES
from systems import SYSTEMS
from tensordict import TensorDict

from torchrl_h2o.data import load
from torchrl_h2o.effects import Effect, effect_from_dict
from torchrl_h2o.residuals import Simulation

HERE = Path(__file__).parent
OWN_MODELS, LAYOUTS = HERE.parent / "models", HERE / "logs"


@dataclass(frozen=True)
class Pair:
    """A log and two sets of effects, each with fitted values.

    Noise of the action is in neither set, because a score fits the noise itself.

    Args:
        name: name of the pair.
        kind: family of the drawn case, log of the machine, or ``composite`` for another simulated case.
        right: what the simulator lacks.
        wrong: what was reported, or might be, in its place.
        values: whether the values of ``wrong`` were ``reported``, ``fitted`` for this pair, or ``chosen`` by hand.
        source: where it was reported; ``constructed`` for a rival of our own.
        case: how the simulator and the data are made; see pairs.yaml.
        logs: folder of the measured logs; None without it.
    """

    name: str
    kind: str
    right: tuple[Effect, ...]
    wrong: tuple[Effect, ...]
    values: str
    source: str
    case: Mapping[str, Any]
    logs: Path | None = None

    @cached_property
    def simulated(self) -> Case | None:
        """The simulated case; None for a measured log."""
        if "family" in self.case:
            return draw_case(FAMILIES, self.case["family"], self.case["number"], self.case["seed"])
        if "system" in self.case:
            recorded = {**self.case, "in_reality": effects_of(self.case["in_reality"])}
            return Case(name=self.name, judge=lambda report, case: {}, truth=recorded["in_reality"], **recorded)
        return None

    @cached_property
    def simulation(self) -> Simulation:
        """The simulator without either set."""
        return self._simulation_of_log() if self.simulated is None else self.simulated.simulation()

    @cached_property
    def data(self) -> TensorDict:
        """The data, TED ``(T,)``."""
        return self._read_log() if self.simulated is None else self.simulated.measure()

    def _read_log(self) -> TensorDict:
        log = self.case["log"]
        layout = log.get("columns")
        own = layout and LAYOUTS / f"{layout}.yaml"
        return load([self.logs / file for file in log["files"]], columns=own if own and own.is_file() else layout)

    def _simulation_of_log(self) -> Simulation:
        log = self.case["log"]
        if "system" in log:
            return Simulation.from_env(SYSTEMS[log["system"]].env())
        own = OWN_MODELS / log["model"]
        return Simulation.from_mjcf(own if own.is_file() else self.logs / log["model"], log["coordinates"], log["step"])


def effects_of(entries: list[dict[str, Any]]) -> tuple[Effect, ...]:
    """Build effects from their dictionaries."""
    return tuple(effect_from_dict(entry) for entry in entries)


def read_pairs(logs: Path | None = None) -> list[Pair]:
    """Read the pairs; data are drawn, recorded or read when they are asked for.

    Args:
        logs: folder of the measured logs; without it, the pairs of these logs are left out.
    """
    told = yaml.safe_load((HERE / "pairs.yaml").read_text(encoding="utf-8"))
    pairs = []
    for entry in told["pairs"]:
        case = dict(entry["case"])
        if "log" in case:
            case["log"] = told["logs"][case["log"]]
        if logs is not None or "log" not in case:
            sets = {name: effects_of(entry[name]) for name in ("right", "wrong")}
            pairs.append(Pair(**{**entry, **sets, "case": case}, logs=logs))
    return pairs
