"""The fault of the columns, if any, that explains a log better than simple physics do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from torchrl_h2o.data.audit.columns import other_columns
from torchrl_h2o.data.audit.finding import Finding
from torchrl_h2o.data.audit.motors import gains, is_opposed, late_actions, late_changes, other_actions
from torchrl_h2o.data.audit.physics import EVIDENCE, Explained, explain
from torchrl_h2o.data.audit.response import Response
from torchrl_h2o.data.audit.rival import Rival, percent
from torchrl_h2o.data.audit.zeros import shifted_zeros, slipped_zeros, turns

ROTORS = (1.0, 3.0, 10.0, 30.0, 100.0)  # inertias of rotors that are tried, in inertias of their joint
FOREIGN = 0.85  # share that is left above which a log may belong to another robot
CLEAR = 0.2  # a simulated hypothesis that leaves this share of what simple physics leave needs no further rivals
LITTLE = 0.05  # share that is left below which no fault of the columns is sought
EQUAL = 0.05  # difference of this share up to which the hypothesis that comes first is taken


def check_model(response: Response, lateness: float = 0.0) -> list[Finding]:
    """Looks for the fault of the columns that explains the log best, if it explains much more than physics do.

    Each hypothesis is fitted together with the simple physics of :func:`~torchrl_h2o.data.audit.physics.explain`, and
    judged in windows that the fit has not used. A gap of the dynamics therefore does not count as a fault.

    Args:
        response: simulated windows.
        lateness: rows by which the velocities are late against their positions, which is no lag of the actions.
    """
    if lost := response.lost:
        names = ", ".join(f"{pair.name} ({response.noise_of(pair):.2g} rad)" for pair in lost)
        words = f"the noise of angles is so large that the simulator knows no start state: {names}"
        return [Finding("model", "warning", words, None, "use a better sensor, or see whether a column is that angle")]
    if response.drowned:
        return []
    found: list[Finding] = []
    while True:
        plain = explain(response)
        better = [rival for rival in _rivals(response, plain, lateness) if rival.is_better]
        if not better:
            return [*found, *(late_changes(response.short, lateness) or _belongs(response, plain))]
        least = min(rival.leaves for rival in better)
        best = next(rival for rival in better if rival.leaves < least + EQUAL)
        found += best.findings
        if best.response is None:
            return found
        response = best.response  # with rotors; the others are compared once more


def _belongs(response: Response, plain: Explained) -> tuple[Finding, ...]:
    """Whether physics predict next to nothing, and not better than that velocities stay."""
    stay = replace(plain, left=response.change / response.scale)
    if plain.share <= FOREIGN or plain.evidence(stay) > EVIDENCE or is_opposed(response):
        return ()
    words = f"the simulator leaves {percent(plain.share)} of the accelerations unexplained, with any usual gains, "
    words += "friction and zeros: another robot's log, a model that lacks much (a load), or noise as large as the "
    words += "motion"
    return (Finding("model", "warning", words, None, "check that model and log belong together"),)


def _rivals(response: Response, plain: Explained, lateness: float) -> list[Rival]:
    """All hypotheses; those with many simulations only if no other sign, order or lag explains nearly all."""
    few, simulated = response.for_hypotheses(), []
    left, free = explain(few), []
    if np.ptp(response.log.action, axis=0).any():
        free = list(gains(response.short, explain(response.short)))
        simulated = [*other_actions(few, left), *late_actions(few, lateness)]
    clear = any(rival.is_better and rival.leaves < CLEAR for rival in simulated)
    if clear or plain.share <= LITTLE:
        return [*free, *simulated]
    tried = list(turns(few))
    zeros = [*shifted_zeros(response, plain, left, tried), *slipped_zeros(response, plain, few, left, tried)]
    rotors = _rotors(response, few, left) if response.is_known else ()
    return [*free, *simulated, *other_columns(few, left), *zeros, *rotors]


def _rotors(response: Response, few: Response, plain: Explained) -> Iterator[Rival]:
    """Heavier rotors, compared in a few windows.

    Behind a gear, a rotor often weighs more than the link, and many models leave it out (``armature``). Every force
    then moves the joints several times too much in the simulator, which can look like late actions, or like another
    robot's log.
    """
    words = "the simulator agrees with the log far better with rotors on its joints (armature); what follows is "
    note = Finding("model", "note", words + "compared with these", None, "a search will tell their size")
    for share in ROTORS:
        if rotors := _rotor_effects(response, share):
            heavier = response.simulation.with_effects(*rotors)
            explained = explain(replace(few, simulation=heavier))
            yield Rival(explained, plain, (note,), replace(response, simulation=heavier, is_known=False))


def _rotor_effects(response: Response, share: float) -> list:
    """A rotor on each hinge and slide joint that has a name, of a share of the joint's inertia in the model."""
    from torchrl_h2o.effects import Armature

    model, rotors = response.simulation.model, []
    for velocity in response.log.velocities:
        joint = int(model.dof_jntid[velocity.dof])
        name = model.joint(joint).name
        if name and int(model.jnt_type[joint]) in (2, 3):  # mjtJoint: slide, hinge
            rotors.append(Armature(share / max(float(model.dof_invweight0[velocity.dof]), 1e-9), name))
    return rotors
