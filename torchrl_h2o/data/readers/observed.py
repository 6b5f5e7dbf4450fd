"""The observations of a log's rows: measured columns, and velocities that are estimated from positions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from tensordict import TensorDictBase
from torchrl import torchrl_logger

from torchrl_h2o.data.readers.error import DataError
from torchrl_h2o.data.readers.log_columns import LogColumns
from torchrl_h2o.data.readers.log_links import Links
from torchrl_h2o.data.readers.log_table import LogTable
from torchrl_h2o.data.readers.units import to_si
from torchrl_h2o.data.readers.velocity import estimate_velocity


def observe(table: LogTable, layout: LogColumns, links: Links) -> tuple[np.ndarray, list[float], Links]:
    """Return the observations of all rows, estimating the velocities that are not in the file.

    Args:
        table: the numbers of the log.
        layout: the observed columns.
        links: the transitions, which determine the unbroken runs.

    Returns:
        Observations (rows, n) in SI; the standard deviation of each column's error, 0 for measured columns; and the
        links between rows that have an estimate.

    Raises:
        DataError: for runs that are too short for an estimate.
    """
    columns, stds = [], []
    known = np.ones(len(table.rows), bool)
    units = {column.name: to_si(column.unit)[0] for column in layout.columns}
    quaternion = _quaternion(table, layout)
    for name in layout.observation:
        position = layout.derivatives.get(name)
        if name in quaternion:
            columns.append(quaternion[name])
            stds.append(0.0)
            continue
        if position is None:
            columns.append(table.columns([name])[:, 0])
            stds.append(0.0)
            continue
        values = table.columns([position])[:, 0]
        try:
            noise = table.noise.get(position, 0.0)
            found = estimate_velocity(values, links.runs, links.dt, angle=units[position] == "rad", least_noise=noise)
        except ValueError as error:
            raise DataError(str(error), "record longer runs", source=table.source, column=name) from error
        torchrl_logger.info(
            f"{table.source}: {name} is estimated from {position} over {found.window} rows, error {found.std:.3g} "
            f"{velocity_unit(units[position])}; {found.window // 2} rows at each end of a run are left out"
        )
        known &= np.isfinite(found.velocity)
        columns.append(np.nan_to_num(found.velocity))
        stds.append(found.std)
    kept = links.between(known) if layout.derivatives else links
    if not len(kept.start):
        raise DataError("no two rows have an estimated velocity", "record longer runs", source=table.source)
    return np.stack(columns, axis=1), stds, kept


def _quaternion(table: LogTable, layout: LogColumns) -> dict[str, np.ndarray]:
    """The numbers w, x, y and z of the quaternion of a free joint from its Euler angles, by their names.

    The angles turn about z, then the new y, then the new x, as those of ROS and of aerospace do (yaw, pitch, roll).
    """
    if not layout.euler:
        return {}
    angles = table.columns(layout.euler)
    turned = Rotation.from_euler("ZYX", angles[:, ::-1]).as_quat(scalar_first=True)
    names = [column.name for column in layout.columns if column.is_quaternion]
    return {name: turned[:, "wxyz".index(name[-1])] for name in names}


@dataclass(frozen=True)
class EstimatedVelocity:
    """An observed column that was estimated, for reports.

    Args:
        name: the column.
        position: the column that it is the derivative of.
        std: standard deviation of its error, root mean square over the transitions.
        unit: unit of the error.
    """

    name: str
    position: str
    std: float
    unit: str


def words_of_estimates(estimated: Sequence[EstimatedVelocity]) -> str:
    """Return a clause for a report that names all estimated columns; empty without any.

    Examples:
        >>> from torchrl_h2o.data.readers.observed import EstimatedVelocity, words_of_estimates
        >>> words_of_estimates([EstimatedVelocity("hip_velocity", "hip", 0.0123, "rad/s")])[:79]
        'not measured but estimated: hip_velocity from hip, with an error of 0.012 rad/s'
    """
    if not estimated:
        return ""
    each = [f"{one.name} from {one.position}, with an error of {one.std:.2g} {one.unit}" for one in estimated]
    return (
        f"not measured but estimated: {', '.join(each)} (standard deviation); such estimates are smooth over time, so "
        "a delay of the actions may look like a lag"
    )


def estimated_velocities(td: TensorDictBase, layout: LogColumns) -> tuple[EstimatedVelocity, ...]:
    """Return the estimated columns of a log's transitions.

    Args:
        td: transitions of batch size [T] from :func:`~torchrl_h2o.data.read_robot_log`.
        layout: the layout that they were read with.
    """
    units = {column.name: to_si(column.unit)[0] for column in layout.columns}
    found = []
    for name, position in layout.derivatives.items():
        std = td["observation_std"][:, layout.observation.index(name)].double().square().mean().sqrt()
        found.append(EstimatedVelocity(name, position, float(std), velocity_unit(units[position])))
    return tuple(found)


def velocity_unit(unit: str) -> str:
    """Return the unit of the derivative of a quantity: ``rad/s`` for ``rad``."""
    return "1/s" if unit == "1" else f"{unit}/s"
