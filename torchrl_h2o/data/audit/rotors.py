"""Rotors that the model may lack, before the log's columns are blamed for what they do."""

from __future__ import annotations

from dataclasses import replace

from torchrl_h2o.data.audit.response import Response
from torchrl_h2o.data.audit.settings import AuditSettings
from torchrl_h2o.data.audit.zeros import unexplained


def with_rotors(response: Response, settings: AuditSettings) -> Response:
    """The windows with the simulator that explains the log best: as it is, or with heavier rotors of all joints.

    Behind a gear, a rotor often weighs more than the link, and many models leave it out (``armature``). Every force
    then moves the joints several times too much in the simulator, which can look like late actions, or like another
    robot's log.

    Args:
        response: simulated windows.
        settings: the rotors that are tried, and how much better one has to be.
    """
    from torchrl_h2o.effects import Armature

    plain = unexplained(response, settings)
    if plain <= settings.misfit or not response.log.pairs:
        return response
    model, best, least = response.simulation.model, response, min(settings.better * plain, settings.rotors_leave)
    for share in settings.rotors:
        rotors = [
            Armature(
                share / max(float(model.dof_invweight0[pair.dof]), 1e-9), model.joint(model.dof_jntid[pair.dof]).name
            )
            for pair in response.log.pairs
        ]
        heavier = replace(response, simulation=response.simulation.with_effects(*rotors))
        if (left := unexplained(heavier, settings)) < least:
            best, least = heavier, left
    return best
