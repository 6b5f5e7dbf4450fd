"""Audits measured data against a simulator, before a search for missing effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from tensordict import TensorDictBase

from torchrl_h2o.data.audit.actions import check_actions
from torchrl_h2o.data.audit.contacts import contact_rows
from torchrl_h2o.data.audit.derivative import Derivative, deviation, fit_derivative, lateness, roughness
from torchrl_h2o.data.audit.excitation import check_excitation
from torchrl_h2o.data.audit.finding import SEVERITIES, Finding
from torchrl_h2o.data.audit.kinematics import check_kinematics
from torchrl_h2o.data.audit.log import AuditedSimulation, Log
from torchrl_h2o.data.audit.model import check_model
from torchrl_h2o.data.audit.response import Response
from torchrl_h2o.data.audit.rows import check_rows
from torchrl_h2o.data.audit.time import check_step, check_time

FEWEST_ROWS = 30  # below which only time stamps are checked


@dataclass(frozen=True)
class Audit:
    """The findings of an audit, the severe ones first.

    Args:
        findings: all findings.
    """

    findings: tuple[Finding, ...]

    @property
    def severe(self) -> tuple[Finding, ...]:
        """Findings that make the result of a search worthless."""
        return tuple(finding for finding in self.findings if finding.severity == "severe")

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """Findings that may lead a search to a wrong result."""
        return tuple(finding for finding in self.findings if finding.severity == "warning")

    def words(self) -> str:
        """One line per finding."""
        return "\n".join(map(str, self.findings)) if self.findings else "no findings"

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {"findings": [finding.to_dict() for finding in self.findings]}

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Audit:
        """The inverse of :meth:`to_dict`."""
        return cls(tuple(Finding.from_dict(finding) for finding in plain["findings"]))


def audit(measured: TensorDictBase | Any, simulation: AuditedSimulation) -> Audit:
    """Looks for faults in measured data that would mislead a search for effects that the simulator lacks.

    The checks of time, rows and kinematics compare the columns with each other. If they find nothing severe, the
    simulator is consulted: units, signs, order and zeros of the angles (``model``), the actions against the
    accelerations (``actions``), and which effects the log can tell apart (``excitation``). An effect that the simulator
    lacks, such as friction, a weak motor or a late drive, is no fault of the data.

    Args:
        measured: transitions (T,) in TED, as the readers of :mod:`torchrl_h2o.data` return them, or
            ``torchrl_h2o.residuals.Measured``.
        simulation: ``torchrl_h2o.residuals.Simulation``; observations are in the units of its state map.

    Returns:
        The findings; ``audit(...).severe`` is empty if a search makes sense.

    Raises:
        DataError: if the data are no valid TED, hold no row or a value that is not finite, or do not have the
            simulator's width.

    Example:
        >>> from torchrl_h2o.data import audit
        >>> from torchrl_h2o.envs import WheelLeggedEnv, noisy_balance_controller, record
        >>> from torchrl_h2o.residuals import Simulation
        >>> data = record(WheelLeggedEnv(), noisy_balance_controller(), 600, seed=0, progress=False)
        >>> simulation = Simulation.from_env(WheelLeggedEnv())
        >>> audit(data, simulation).severe
        ()
        >>> data["action"] = -data["action"]
        >>> print(audit(data, simulation).severe[0].words)
        the simulator leaves ... of the accelerations unexplained, and ... if the action of wheels has the other sign
    """
    log = Log.of(measured, simulation)
    if len(log) < FEWEST_ROWS:
        words = f"{len(log)} rows are too few to tell a fault of the data from chance"
        return ordered([*check_time(log, simulation, ()), Finding("rows", "note", words, None, "record more")])
    touching, found = contact_rows(log, simulation)
    log = replace(log, touching=touching)
    derivatives = [fit_derivative(log, pair) for pair in log.pairs]
    step = Response.of(log, simulation, None)
    noise = estimate_noise(log, derivatives, step)
    found += check_time(log, simulation, derivatives)
    found += check_rows(log, simulation)
    if not any(finding.severity == "severe" and finding.check == "time" for finding in found):
        kinematics = check_kinematics(log, derivatives, noise, step)
        severe = any(finding.severity == "severe" for finding in kinematics)
        # a wrong time step can look like wrong columns
        found += (check_step(step) if severe else []) or kinematics
    if any(finding.severity == "severe" for finding in found):
        return ordered(found)
    if log.estimated_std is not None:  # the errors of estimated velocities are smooth, so rows do not show them
        noise = np.maximum(noise, log.estimated_std)
    response = Response.of(log, simulation, noise)
    if response is None:
        words = "the data hold too few unbroken rows of positions and velocities to compare them with the simulator"
        words += ", contacts left out" if touching.any() else ""
        return ordered([*found, Finding("model", "note", words), *check_actions(log, None)])
    found += check_actions(log, response)
    if not any(finding.severity == "severe" for finding in found):
        found += check_model(response, lateness(derivatives))
    if not any(finding.severity == "severe" for finding in found):
        found += check_excitation(response)
    return ordered(found)


def ordered(findings: Sequence[Finding]) -> Audit:
    """An audit with the severe findings first, otherwise in the given order."""
    return Audit(tuple(sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity))))


def estimate_noise(log: Log, derivatives: Sequence[Derivative], step: Response | None) -> np.ndarray:
    """Upper estimates of the noise of each observation, (n,): the smallest of those that the data allow.

    They come from third differences, from positions against velocities, and from the simulator's error in one step.
    """
    noise = np.array([roughness(log, column) for column in range(len(log.names))])
    for derivative in derivatives:
        noise[derivative.pair.position] = derivative.position_noise
        noise[derivative.pair.velocity] = derivative.velocity_noise
    if step is not None:
        simulated = np.array([deviation(error[np.isfinite(error)]) for error in step.error.T]) / np.sqrt(2.0)
        usable = np.isfinite(step.error).mean(0) > 0.5
        noise = np.where(usable, np.minimum(noise, simulated), noise)
    return noise
