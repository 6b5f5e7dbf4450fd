"""Contacts of the model in the measured rows that make its response to forces meaningless."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchrl_h2o.data.audit.finding import Finding, Rows
from torchrl_h2o.data.audit.log import AuditedSimulation, Log

CHECK = "model"
SAMPLE = 1000  # rows that are looked at first; without a contact in them, the others are not looked at
SHARE = 0.001  # share of rows in contact from which they are named


def contact_rows(log: Log, simulation: AuditedSimulation) -> tuple[np.ndarray, list[Finding]]:
    """Rows in which the model touches itself or, if its base is fixed, its surroundings, (T,), and a note of them.

    A model whose links overlap, such as a trunk that touches its hips, is held by that contact and answers no torque.
    A robot that walks or drives touches the floor on purpose, so contacts of a moving base with the world do not count.
    """
    touching, bodies = np.zeros(len(log), bool), set()
    sample = np.unique(np.linspace(0, len(log) - 1, min(len(log), SAMPLE)).astype(int))
    for rows in (sample, np.setdiff1d(np.arange(len(log)), sample)):
        for row, found in zip(rows, _touching(simulation, log.observation[rows]), strict=True):
            touching[row], bodies = bool(found), bodies | found
        if not touching.any():
            break
    if touching.mean() <= SHARE:
        return np.zeros(len(log), bool), []
    names = ", ".join(sorted(bodies)[:6]) + (", ..." if len(bodies) > 6 else "")
    words = f"the model is in contact in {touching.mean():.0%} of the rows ({names}), where its response to actions "
    words += "says nothing about the log"
    remedy = "if the robot does not touch there, switch these contacts off in the model (contype, conaffinity, exclude)"
    return touching, [Finding(CHECK, "note", words, Rows.of(touching), remedy)]


def _touching(simulation: AuditedSimulation, observations: np.ndarray) -> list[set[str]]:
    """Names of the bodies in contact for each of some observations (B, n)."""
    import mujoco

    model, found = simulation.model, []
    data, counts = mujoco.MjData(model), _counted(model)
    for state in simulation.state_map.states(observations):
        data.qpos = state[: model.nq]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        pairs = model.geom_bodyid[data.contact.geom[data.contact.dist <= 0.0]].reshape(-1, 2)
        found.append({model.body(int(body)).name or f"body {body}" for body in pairs[counts[tuple(pairs.T)]].ravel()})
    return found


def _counted(model: Any) -> np.ndarray:
    """Whether a contact of two bodies counts, (nbody, nbody): those of one tree, and of a fixed tree with the world."""
    root, fixed = model.body_rootid, np.ones(model.nbody, bool)
    for joint in range(model.njnt):
        if int(model.jnt_type[joint]) in (0, 2):  # mjtJoint: free, slide
            fixed &= root != int(model.jnt_bodyid[joint])
    still = model.body_weldid == 0
    same = (root[:, None] == root) & (np.arange(model.nbody) > 0)
    return same | (still[:, None] & fixed) | (still & fixed[:, None])
