"""Guess what each column of a log is, from its name, its unit in brackets, and its values."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from torchrl_h2o.data.readers.units import UNITS, to_si

_CURRENTS = ("current", "iq", "amps")
# a commanded force is no desired position
_FORCES = ("tau", "torque", "torques", "effort", "force", "moment", *_CURRENTS)
_VOLTS = ("volt", "volts", "voltage", "vin", "vm")
_DUTY = ("pwm", "duty")
_WORDS = {
    "time": ("t", "time", "timestamp", "stamp", "secs", "seconds", "millis", "clock"),
    "done": ("done", "terminal", "terminated", "fallen"),
    "reward": ("reward",),
    "run": ("run", "episode", "trial", "rollout", "trajectory"),
    "command": ("cmd", "command", "commanded"),
    "desired": ("des", "desired", "ref", "reference", "target", "goal", "setpoint", "sp"),
    "velocity": (
        *("vel", "velocity", "velocities", "dot", "qd", "dq", "qdot", "omega", "speed", "rate", "gyro", "v", "w"),
    ),
    "action": (*_FORCES, *_VOLTS, *_DUTY, "u", "input", "action", "act"),
    "position": (
        *("pos", "position", "positions", "angle", "q", "theta", "phi", "psi", "roll", "pitch", "yaw", "alpha", "beta"),
        *("x", "y", "z", "height", "encoder", "enc", "joint", "hip", "knee", "ankle", "elbow", "shoulder", "wrist"),
    ),
}
_PLACES = ("pos", "position", "positions", "angle")
_WHERE = (*_PLACES, "q", "enc", "encoder")  # a position, but not of what
_LENGTHS = ("x", "y", "z", "height", "slide", "cart", "rail")
_SI = {"position": "rad", "velocity": "rad/s", "desired position": "rad", "desired velocity": "rad/s"}
_NO_COMMANDS = (
    *("dt", "temp", "temperature", "battery", "humidity", "id", "seq", "index", "count", "error", "err", "mode"),
    *("state", "status", "acc", "acceleration", "accel", "imu", "mag"),
)
_COMPUTED = ("cos", "sin", "squared", "square", "sq", "err", "error", "errors")  # of another column
_NEVER_COMMANDS = ("squared", "square", "err", "error", "errors")
PERHAPS = "perhaps an action"  # the note of a column that may be one
_STEADY = 0.3  # a voltage with one sign that usually changes by less than this share is a supply's
LARGEST_ANGLE = 8 * np.pi  # rad; beyond it, degrees are more likely
_SHORTEST_RUN = 5  # rows that the usual run of a log has at least
_EVEN = 0.5  # share of the median by which a clock's usual step may differ from it
_MOSTLY, _MANY = 0.98, 0.8  # shares of the steps of a clock that are not backwards, and that are forwards


@dataclass(frozen=True)
class Guess:
    """What a column may be.

    Args:
        name: the column.
        kind: one of time, done, reward, run, position, velocity, action, desired position, desired velocity, or
            unknown.
        unit: its unit.
        stem: the name without the words of its kind and its unit, by which positions and velocities are paired.
        note: what the user should check; empty if nothing is doubtful.
        of_model: the model's name of this quantity, if the column has it, apart from words such as "desired".
        scale: a factor in addition to the unit's.
        offset: a constant in SI that is added.
    """

    name: str
    kind: str
    unit: str = "1"
    stem: str = ""
    note: str = ""
    of_model: str | None = None
    scale: float = 1.0
    offset: float = 0.0


def guess_columns(
    values: Mapping[str, np.ndarray | None], model_names: Mapping[str, tuple[str, str | None]] | None = None
) -> list[Guess]:
    """Guess the kind and unit of each column; at most one is the time.

    Args:
        values: the numbers of each column by name; None for a column that is not numbers.
        model_names: kind and SI unit (None if not known) of the names in the user's model. A column with such a name,
            apart from case, signs and its own unit, is that quantity, whatever its words mean elsewhere. With "desired"
            or "command" beside it, it is the command of that actuator, or what is desired of that joint.

    Example:
        >>> import numpy as np
        >>> from torchrl_h2o.data.readers.guess.roles import guess_columns
        >>> found = guess_columns({"t_ms": np.arange(5.0), "hip_vel (deg/s)": np.ones(5), "mode": None})
        >>> [(column.kind, column.unit) for column in found]
        [('time', 'ms'), ('velocity', 'deg/s'), ('unknown', '1')]
    """
    known = {_letters(name): (name, *quantity) for name, quantity in (model_names or {}).items()}
    found = [_guess(name, numbers, known) for name, numbers in values.items()]
    actions = [guess for guess in found if guess.kind == "action"]
    supplies = [guess for guess in actions if guess.of_model is None and _is_supply(guess, values)]
    if len(supplies) < len(actions):
        note = "hardly changes, as the voltage of a supply"
        found = [replace(guess, kind="unknown", note=note) if guess in supplies else guess for guess in found]
    found = [one if one.of_model is not None else _of_another(one, values) for one in found]
    if not any(one.kind == "time" for one in found):
        clocks = [one.name for one in found if _is_time(one, values[one.name])][:1]
        found = [clock(one.name, values[one.name]) if one.name in clocks else one for one in found]
    for kind in ("time", "done", "reward", "run"):
        same = [i for i, guess in enumerate(found) if guess.kind == kind]
        for i in same[1:]:
            found[i] = replace(found[i], kind="unknown", note=f"another column of {kind}")
    return found


def _of_another(guess: Guess, values: Mapping[str, np.ndarray | None]) -> Guess:
    """The guess, or an unknown column if it holds what follows from another one, or its raw value."""
    words, note = words_of(guess.name), ""
    computed = [word for word in words if word in _COMPUTED]
    if guess.kind == "action":  # a torque may be a sine
        computed = [word for word in computed if word in _NEVER_COMMANDS]
    if computed:
        note = "follows from other columns"
    elif "raw" in words and len(words) > 1:
        plain = [word for word in words if word != "raw"]
        alike = [name for name, numbers in values.items() if numbers is not None and np.ptp(numbers) > 0.0]
        of = next((name for name in alike if words_of(name) == plain), None)
        note = f"the raw value of {of}" if of else ""
    return replace(guess, kind="unknown", note=note) if note else guess


def _guess(name: str, numbers: np.ndarray | None, known: Mapping[str, tuple[str, str, str | None]]) -> Guess:
    if numbers is None:
        return Guess(name, "unknown", note="not numbers")
    plain, unit = without_unit(name)
    words = words_of(plain)
    of_model, kind, si = _of_model(plain, known) or (None, _kind(words, numbers), None)
    stem = " ".join(word for word in words if word not in (*_WORDS["velocity"], *_WORDS["action"], *_WHERE))
    if kind == "time":
        return Guess(name, kind, *_unit_of_time(numbers, unit))
    if unit is not None:
        return Guess(name, kind, unit, stem, of_model=of_model)
    unit, note = _unit_of(kind, si, words, numbers)
    return Guess(name, kind, unit, stem, note, of_model)


def _of_model(plain: str, known: Mapping[str, tuple[str, str, str | None]]) -> tuple[str, str, str | None] | None:
    """The model's name of a column, its kind and its unit."""
    if (letters := _letters(plain)) in known:
        return known[letters]
    asked = (*_WORDS["command"], *_WORDS["desired"])
    words = words_of(plain)
    bare = "".join(word for word in words if word not in asked)
    if bare not in known or len(words) == len([word for word in words if word not in asked]):
        return None
    name, kind, si = known[bare]
    return name, kind if kind == "action" else f"desired {kind}", si


def clock(name: str, numbers: np.ndarray | None) -> Guess:
    """A column of time, with the unit that its step suggests."""
    return Guess(name, "time", *_unit_of_time(np.zeros(2) if numbers is None else numbers, None))


def is_clock(numbers: np.ndarray | None) -> bool:
    """Whether a column grows in steps that are mostly alike."""
    if numbers is None or len(numbers) < 3 or not np.isfinite(numbers).all():
        return False
    steps = np.diff(numbers)
    usual = float(np.median(steps))
    return (
        usual > 0.0
        and (steps >= 0.0).mean() >= _MOSTLY
        and (steps > 0.0).mean() >= _MANY
        and np.median(np.abs(steps - usual)) <= _EVEN * usual
    )


def is_counter(numbers: np.ndarray | None) -> bool:
    """Whether a column counts rows."""
    return numbers is not None and bool((np.diff(numbers) == 1.0).all())


def _is_time(guess: Guess, numbers: np.ndarray | None) -> bool:
    """Whether a column whose name tells nothing is a regular clock: its steps are alike, but it counts no rows."""
    told = guess.kind != "unknown" or guess.note or any(word in _NO_COMMANDS for word in words_of(guess.name))
    if told or numbers is None or not is_clock(numbers) or is_counter(numbers):
        return False
    steps = np.diff(numbers)
    return bool((np.abs(steps - np.median(steps)) <= _EVEN * np.median(steps)).mean() >= _MOSTLY)


def _kind(words: list[str], numbers: np.ndarray) -> str:
    fits = {kind for kind, known in _WORDS.items() if any(word in known for word in words)}
    if "".join(words) in _VOLTS:  # V_in
        return "action"
    if "current" in words and any(word in _PLACES for word in words):
        fits.discard("action")  # the current position
    if "time" in fits and not ((np.diff(numbers) >= 0).mean() > 0.9 and np.ptp(numbers) > 0):
        fits.remove("time")
    changes = np.diff(numbers) != 0
    if "run" in fits and not (changes.sum() * _SHORTEST_RUN <= len(numbers) and (numbers == np.round(numbers)).all()):
        fits.remove("run")
    if fits & {"desired", "command"}:
        motion = () if any(word in _FORCES for word in words) else ("velocity", "position")
        return next((f"desired {kind}" for kind in motion if kind in fits), "action")
    return next((kind for kind in _WORDS if kind in fits), "unknown")


def may_be_command(name: str, values: np.ndarray) -> bool:
    """Whether a column of which nothing else is known may hold the commands of an actuator: it goes up and down."""
    words, steps = words_of(name), np.diff(values)
    known = any(word in _NO_COMMANDS or word.startswith("dd") or word.endswith("ddot") for word in words)
    return not known and bool((steps > 0).any() and (steps < 0).any() and np.ptp(np.sign(values)) > 0)


def kind_of_joint(name: str) -> str | None:
    """``"m"`` or ``"rad"`` if a position's name tells that it is a length or an angle; else None."""
    words = words_of(name)
    if any(word in _LENGTHS for word in words):
        return "m"
    named = set(_WORDS["position"]).difference(_WHERE, ("joint",)) | {"angle", "angles", "pole", "deg", "rad"}
    return "rad" if any(word in named for word in words) else None


def is_force(name: str) -> bool:
    """Whether a column's name is that of a force, a torque or a current."""
    return any(word in _FORCES for word in words_of(name))


def _is_supply(guess: Guess, values: Mapping[str, np.ndarray | None]) -> bool:
    """Whether a voltage has one sign and hardly changes."""
    numbers = values[guess.name]
    finite = np.zeros(0) if numbers is None else numbers[np.isfinite(numbers)]
    if not len(finite) or not any(word in _VOLTS for word in words_of(guess.name)):
        return False
    least, most = np.quantile(np.abs(finite), (0.05, 0.95))
    return bool(np.ptp(np.sign(finite)) == 0 and least > (1.0 - _STEADY) * most)


def words_of(name: str) -> list[str]:
    """The words of a name: at signs, digits and changes of case; ``hipVel2`` is hip, vel, 2, ``angleD`` angle, dot."""
    name = re.sub(r"([A-Za-z]*[a-z])D(?![A-Za-z])", _slope, name)
    words = [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", name)]
    return [part for word in words for part in _derivative(word)]


def slope_of(velocity: str) -> tuple[str, ...]:
    """The words of the position of which a velocity is the slope by its name: ``angleD`` is that of angle."""
    return tuple(word for word in words_of(without_unit(velocity)[0]) if word not in _WORDS["velocity"])


def _slope(match: re.Match[str]) -> str:
    """``angleD`` as ``angle_dot``; but the joint or encoder D stays what it is."""
    word = match.group(1)
    position = word.lower() in _WORDS["position"] and word.lower() not in ("enc", "encoder", "joint")
    return f"{word}_dot" if position else match.group(0)


def _derivative(word: str) -> list[str]:
    """Split a time derivative that is written as one word, ``thetadot`` or ``dtheta``, into theta, dot."""
    known = any(word in words for words in _WORDS.values())
    for position in () if known else (word.removesuffix("dot"), word.removeprefix("d")):
        if position != word and position in _WORDS["position"]:
            return [position, "dot"]
    return [word]


def _letters(name: str) -> str:
    return "".join(re.findall(r"[a-z0-9]", name.lower()))


def without_unit(name: str) -> tuple[str, str | None]:
    """Split a name such as ``hip_vel (deg/s)``, ``hip[rad]`` or ``t_ms`` into the name and its unit, if it has one."""
    bracket = re.search(r"[\[(]([^\])]+)[\])]\s*$", name)
    candidates = [(bracket.start(), bracket.group(1))] if bracket else []
    suffix = re.search(r"[_ .](deg|degs|rad|ms|us|ns|rpm|mm|cm|Nm|nm|mNm|rads|degps|radps)$", name)
    if suffix:
        spelled = {"rads": "rad/s", "radps": "rad/s", "degps": "deg/s", "degs": "deg/s", "nm": "Nm"}
        candidates.append((suffix.start(), spelled.get(suffix.group(1), suffix.group(1))))
    for start, unit in candidates:
        try:
            to_si(unit)
        except KeyError:
            continue
        if not unit.isdigit():  # q[1] is an entry, not a unit
            return name[:start], unit
    return name, None


def _unit_of_time(numbers: np.ndarray, unit: str | None) -> tuple[str, str, str]:
    step = float(np.median(np.diff(numbers)))
    unit = unit or next(unit for unit, most in (("s", 0.5), ("ms", 500.0), ("us", 5e5), ("ns", np.inf)) if step <= most)
    seconds = step * UNITS[unit][1]
    rate = f", {1 / seconds:.4g} Hz" if seconds > 0 else ""
    return unit, "", f"check: the median step is {step:.4g}, which is {seconds:.4g} s{rate}"


def _unit_of(kind: str, si: str | None, words: list[str], numbers: np.ndarray) -> tuple[str, str]:
    unit, largest = si or _SI.get(kind, "1"), float(np.abs(numbers[np.isfinite(numbers)]).max(initial=0.0))
    if si is not None and (kind != "position" or si != "rad"):
        return unit, f"check the unit: the largest value is {largest:.3g}"
    if kind == "action" and any(word in _DUTY for word in words):
        return (
            "1",
            f"the largest value is {largest:.3g}; for an actuator that takes volts: unit V, scale: volts per count",
        )
    if kind == "action":
        units = {"A": _CURRENTS, "N": ("force",), "V": _VOLTS}
        spelled = [*words, "".join(words)]
        unit = next((unit for unit, known in units.items() if any(word in known for word in spelled)), "N·m")
    elif kind not in _SI:
        return unit, ""
    elif si is None and any(word in _LENGTHS for word in words):
        unit = unit.replace("rad", "m")
    elif kind.endswith("position") and largest > LARGEST_ANGLE:
        return "deg", f"check the unit: the largest value is {largest:.3g}, which is much for rad"
    return unit, f"check the unit: the largest value is {largest:.3g}"
