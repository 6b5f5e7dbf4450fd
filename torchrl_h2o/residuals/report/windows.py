"""Parts of the data that a report shows: windows, measured against simulated, and the error of each run."""

from dataclasses import dataclass


@dataclass(frozen=True)
class WindowQuantity:
    """One observed quantity in a window, from its start to its end.

    Args:
        name: name of the quantity.
        unit: its unit.
        measured: (H + 1), measured values.
        before: (H + 1), simulated without the effects, from the measured state at the start; NaN from the step on at
            which the simulation diverges.
        after: (H + 1), simulated with all effects.

    Raises:
        ValueError: if the lengths differ.
    """

    name: str
    unit: str
    measured: tuple[float, ...]
    before: tuple[float, ...]
    after: tuple[float, ...]

    def __post_init__(self):
        if not len(self.measured) == len(self.before) == len(self.after):
            raise ValueError(
                f"{self.name} has {len(self.measured)} measured values and {len(self.before)} and {len(self.after)} "
                "simulated ones; give one of each per time"
            )


@dataclass(frozen=True)
class ShownWindow:
    """A window of the data in which the simulations run from the measured state under the measured actions.

    Args:
        rank: ``"worst"``, ``"median"`` or ``"best"`` by the error with the effects.
        run: index of the run.
        row: index of the window's first row in the data.
        start: time of this row, in s.
        ahead: (H + 1), time since the start, in s.
        before: error without the effects at the end of the window: root mean square over the dimensions, each divided
            by the standard deviation of its change over such a window; NaN if the simulation diverges.
        after: the same error with all effects.
        quantities: the quantities whose errors are largest over all windows.

    Raises:
        ValueError: if a quantity does not have one value per time.
    """

    rank: str
    run: int
    row: int
    start: float
    ahead: tuple[float, ...]
    before: float
    after: float
    quantities: tuple[WindowQuantity, ...]

    def __post_init__(self):
        for quantity in self.quantities:
            if len(quantity.measured) != len(self.ahead):
                raise ValueError(
                    f"{quantity.name} has {len(quantity.measured)} measured values at {len(self.ahead)} times; "
                    "give one of each per time"
                )


@dataclass(frozen=True)
class RunError:
    """One-step error of one unbroken run, in the unit of the report's summary.

    Args:
        name: name or index of the run.
        rows: number of transitions that the error is computed from.
        before: error without the effects.
        after: error with all effects.
        held_out: True if no fit used these transitions, which are then the run's held-out part alone.
    """

    name: str
    rows: int
    before: float
    after: float
    held_out: bool
