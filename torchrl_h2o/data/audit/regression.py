"""Robust fits of the changes of the velocities to responses, and what they leave unexplained."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from torchrl_h2o.data.audit.finding import Finding
from torchrl_h2o.data.audit.response import Response

ROBUST = 3.0  # usual deviations from which a window loses weight
SIGNIFICANCE = 6.0  # standard errors that a fitted value must have
NEGLIGIBLE = 0.02  # size of a response, in usual changes of the velocities, below which it shows nothing
MISFIT = 0.3  # share of the accelerations that the simulator leaves unexplained above which causes are sought
BETTER = 0.6  # share of this misfit that a cause must leave at most
FOREIGN = 0.85  # misfit above which a log may belong to another robot
CANCELLED = 0.5  # share of the actions' effect that friction must leave for gains to be judged
GAIN_WARNING = (0.4, 2.5)  # gains outside these are those of a weak or strong motor
ROTORS = (1.0, 3.0, 10.0, 30.0, 100.0)  # inertias of rotors that are tried, in inertias of their joint
ROTORS_LEAVE = 0.65  # share of the accelerations that may stay unexplained with rotors, any gains and friction


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted linear combination of responses.

    Args:
        values: coefficients, (P,).
        errors: their standard errors, (P,).
        unexplained: weighted share of the target's square that is left.
    """

    values: np.ndarray
    errors: np.ndarray
    unexplained: float


def fit(target: np.ndarray, responses: np.ndarray, scale: np.ndarray, weights: np.ndarray) -> Fit:
    """Least squares of ``target`` (W, m) on ``responses`` (W, m, P), in units of ``scale`` (m,), weighted (W, m)."""
    root = np.sqrt(weights) / scale
    y, x = (target * root).ravel(), (responses * root[..., None]).reshape(-1, responses.shape[-1])
    size = np.sqrt((x**2).sum(0))
    size = np.where(size > 0.0, size, 1.0)
    gram = (x / size).T @ (x / size) + 1e-9 * np.eye(len(size))
    values = np.linalg.solve(gram, (x / size).T @ y)
    left = float(((y - x / size @ values) ** 2).sum())
    free = max(1, int((root > 0.0).sum()) - len(size))
    # windows follow each other closely, so their errors are correlated: two velocities count as one
    errors = np.sqrt(2.0 * left / free * np.diag(np.linalg.inv(gram)))
    return Fit(values / size, errors / size, left / max(float((y**2).sum()), 1e-300))


def robust_weights(error: np.ndarray) -> np.ndarray:
    """Weights (W, m) of Huber's loss for errors (W, m); zero where an error is not finite."""
    finite = np.isfinite(error)
    usual = np.nanmedian(np.where(finite, np.abs(error), np.nan), axis=0)
    limit = ROBUST * np.maximum(1.4826 * usual, 1e-12)
    return np.where(finite, np.minimum(1.0, limit / np.maximum(np.abs(error), 1e-12)), 0.0)


def robust_fit(target: np.ndarray, responses: np.ndarray, scale: np.ndarray) -> Fit:
    """Fits with Huber's weights, reweighted three times; rows that are not finite are left out."""
    finite = np.isfinite(target) & np.isfinite(responses).all(-1)
    target, responses = np.where(finite, target, 0.0), np.where(finite[..., None], responses, 0.0)
    found = fit(target, responses, scale, finite * robust_weights(target / scale))
    for _ in range(3):
        weights = finite * robust_weights((target - responses @ found.values) / scale)
        found = fit(target, responses, scale, weights)
    return found


def friction_responses(response: Response, *, constant: bool = True) -> np.ndarray:
    """Responses to dry and viscous friction and, if wanted, a constant force of each joint, (W, m, 2 m or 3 m)."""
    velocity = response.before + 0.5 * response.change
    spread = np.maximum(velocity.std(0), 1e-12)
    terms = [np.tanh(velocity / (0.1 * spread)), velocity / spread] + constant * [np.ones_like(velocity)]
    return np.concatenate([response.by_force * term[:, None] for term in terms], axis=-1)


def friction_dominates(response: Response) -> bool:
    """Whether friction takes most of what the motors do, with the gains that they have in the simulator.

    This is usual in geared arms. What a fit leaves is then small beside the actions' effect, even if it is large beside
    the motion, and the fit trades the gain of a motor against friction. Constant forces and gravity, which a motor may
    have to hold, are no friction: they are taken out first.
    """
    effect = response.by_gain.sum(-1)
    with_friction = np.concatenate([friction_responses(response), response.by_zero], -1)
    moving = response.change.shape[1]
    held = with_friction[..., 2 * moving :]
    varied = _usual_rest(effect, held, response)
    without, rest = (_usual_rest(response.target - effect, by, response) for by in (held, with_friction))
    driven = varied > NEGLIGIBLE
    return bool(rest[driven].sum() < CANCELLED * min(varied[driven].sum(), without[driven].sum()))


def _usual_rest(target: np.ndarray, responses: np.ndarray, response: Response) -> np.ndarray:
    """Median size of what a fit of a target (W, m) leaves, in usual changes of the velocities, (m,)."""
    found = robust_fit(target, responses, response.scale)
    return np.nanmedian(np.abs(target - responses @ found.values), axis=0) / response.scale


def unexplained(response: Response, windows: np.ndarray | None = None) -> float:
    """Usual share of the accelerations that no gains, friction, constant forces and small shifts of zeros explain.

    Args:
        response: simulated windows, to all of which these are fitted.
        windows: mask (W,) of those whose usual share is meant; None for all.
    """
    return unexplained_with_gains(response, windows)[0]


def unexplained_with_gains(response: Response, windows: np.ndarray | None = None) -> tuple[float, np.ndarray]:
    """The same share, and the fitted gain of each action, (nu,)."""
    responses = np.concatenate([response.by_gain, friction_responses(response), response.by_zero], -1)
    found = robust_fit(response.target, responses, response.scale)
    left = np.abs(response.target - responses @ found.values)
    share = np.nanmedian(left if windows is None else left[windows], axis=0) / response.scale
    return float(np.mean(share)), found.values[: response.by_gain.shape[-1]]


def with_rotors(response: Response) -> tuple[Response, list[Finding]]:
    """The windows with the simulator that explains them best, as it is or with heavier rotors, and a finding about it.

    Behind a gear, a rotor often weighs more than the link, and many models leave it out (``armature``). Every force
    then moves the joints several times too much in the simulator, which can look like late actions, or like another
    robot's log. The heaviest rotors leave nothing of the model's own weight; if the motors need another strength as
    well, any joints that follow their motors would agree with it.
    """
    plain = unexplained(response)
    if plain <= MISFIT:
        return response, []
    best, least, gains, heaviest = response, min(BETTER * plain, ROTORS_LEAVE), np.ones(0), 0.0
    for share in ROTORS:
        rotors = _rotors(response, share)
        heavier = replace(response, simulation=response.simulation.with_effects(*rotors))
        left, found = unexplained_with_gains(heavier) if rotors else (np.inf, gains)
        if left < least:
            best, least, gains, heaviest = heavier, left, found, share
    if best is response:
        return response, []
    low, high = GAIN_WARNING
    if heaviest == ROTORS[-1] and len(gains) and ((gains < low) | (gains > high)).all():
        words = f"the simulator agrees with the log only if its joints had {heaviest:.0f} times their inertia and its "
        words += f"motors {', '.join(f'{gain:.2g}' for gain in gains)} times their gain: another robot's log, or the "
        words += "model does not explain it"
        return best, [Finding("model", "warning", words, None, "check that model and log belong together")]
    words = "the simulator agrees with the log far better with rotors on its joints (armature); what follows is "
    words += "compared with these"
    return best, [Finding("model", "note", words, None, "a search will tell their size")]


def _rotors(response: Response, share: float) -> list:
    """A rotor on each hinge and slide joint that has a name, of a share of the joint's inertia in the model."""
    from torchrl_h2o.effects import Armature

    model, rotors = response.simulation.model, []
    for velocity in response.log.velocities:
        joint = int(model.dof_jntid[velocity.dof])
        name = model.joint(joint).name
        if name and int(model.jnt_type[joint]) in (2, 3):  # mjtJoint: slide, hinge
            rotors.append(Armature(share / max(float(model.dof_invweight0[velocity.dof]), 1e-9), name))
    return rotors


def percent(share: float) -> str:
    """A share in words."""
    return "all" if share >= 0.995 else f"{share:.0%}"
