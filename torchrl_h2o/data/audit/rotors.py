"""Rotors that the model may lack, before the log's columns are blamed for what they do."""

from __future__ import annotations

from dataclasses import replace

from torchrl_h2o.data.audit.response import Response
from torchrl_h2o.data.audit.settings import AuditSettings
from torchrl_h2o.data.audit.unexplained import unexplained


def with_rotors(response: Response, settings: AuditSettings) -> Response:
    """The windows with the simulator that explains the log best: as it is, or with heavier rotors of all joints.

    Behind a gear, a rotor often weighs more than the link, and many models leave it out (``armature``). Every force
    then moves the joints several times too much in the simulator, which can look like late actions, or like another
    robot's log.

    Args:
        response: simulated windows.
        settings: the rotors that are tried, and how much better one has to be.
    """
    plain = unexplained(response, settings)
    if plain <= settings.misfit:
        return response
    best, least = response, min(settings.better * plain, settings.rotors_leave)
    for share in settings.rotors:
        rotors = _rotors(response, share)
        heavier = replace(response, simulation=response.simulation.with_effects(*rotors))
        if rotors and (left := unexplained(heavier, settings)) < least:
            best, least = heavier, left
    return best


def _rotors(response: Response, share: float) -> list:
    """A rotor on each hinge and slide joint that has a name, of a share of the joint's inertia in the model."""
    from torchrl_h2o.effects import Armature

    model, rotors = response.simulation.model, []
    for pair in response.log.pairs:
        joint = int(model.dof_jntid[pair.dof])
        name = model.joint(joint).name
        if name and int(model.jnt_type[joint]) in (2, 3):  # mjtJoint: slide, hinge
            rotors.append(Armature(share / max(float(model.dof_invweight0[pair.dof]), 1e-9), name))
    return rotors
