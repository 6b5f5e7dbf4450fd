"""Read ROS 2 messages of an MCAP bag as columns: ``sensor_msgs/msg/JointState`` gives ``hip.position`` and the like.

The messages of one topic are the rows. Columns of other topics, such as commands, have the topic in front,
``/commands:hip.effort``, and hold the last value that was received before the row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_h2o.data.readers.error import DataError, unreadable
from torchrl_h2o.data.readers.file_kind import require_plausible_size
from torchrl_h2o.data.readers.formats.raw_table import RawTable, require_package, table_of

if TYPE_CHECKING:
    from torchrl_h2o.data.readers.log_columns import LogColumns

_JOINTS, _NUMBERS = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"
_FIELDS = ("position", "velocity", "effort")


@dataclass
class _Topic:
    """The messages of a topic.

    Args:
        kind: the type of the messages.
        received: time at which each message was recorded, in ns.
        stamps: time in the header of each message, in ns; the time of recording for a message without a header.
        rows: the values of each message by column.
    """

    kind: str
    received: list[int] = field(default_factory=list)
    stamps: list[int] = field(default_factory=list)
    rows: list[dict[str, float]] = field(default_factory=list)

    def column(self, name: str) -> np.ndarray:
        """The values of a column, (messages,); NaN in messages without it."""
        return np.array([row.get(name, np.nan) for row in self.rows])

    @property
    def names(self) -> list[str]:
        """The columns in the order of their first appearance."""
        return list(dict.fromkeys(name for row in self.rows for name in row))


def read_mcap(path: Path, layout: LogColumns | None) -> RawTable:
    """Read the joint states of a bag, with the column ``time``: seconds since the first message, from its header.

    Rows before the first message of another topic of the layout are left out.

    Args:
        path: the bag.
        layout: ``topic``, the topic whose messages are the rows; needed if several topics have joint states. Without
            a layout, the rows are those of the topic with most messages.

    Raises:
        DataError: for a damaged bag, by its checksums, a bag without joint states, or an unknown or missing topic.
    """
    topics = _topics(path)
    name = _main_topic(topics, layout, path)
    main = topics[name]
    described = [] if layout is None else [column.name for column in layout.columns]
    used = {column.split(":")[0] for column in described if ":" in column}
    received = np.array(main.received)
    others = {other: content for other, content in topics.items() if other != name}
    begin = max((content.received[0] for other, content in others.items() if other in used), default=received[0])
    rows = np.flatnonzero(received >= begin)
    columns = {"time": partial(_seconds, np.array(main.stamps)[rows], main.stamps[0])}
    columns |= {column: partial(_rows_of, main, column, rows) for column in main.names}
    for other, content in others.items():
        last = np.searchsorted(np.array(content.received), received[rows], side="right") - 1
        columns |= {f"{other}:{column}": partial(_held, content, column, last) for column in content.names}
    if len(rows) < 2:
        raise DataError(f"there are {len(rows)} messages of {name}", "a transition needs two", source=path)
    several = sum(topic.kind == _JOINTS for topic in topics.values()) > 1
    return replace(table_of(columns, len(rows), path, layout), topic=name if several else None)


def _seconds(stamps: np.ndarray, first: int) -> np.ndarray:
    return (stamps - first) / 1e9  # subtracted as integers: nanoseconds since 1970 have no room in float64


def _rows_of(topic: _Topic, column: str, rows: np.ndarray) -> np.ndarray:
    return topic.column(column)[rows]


def _held(topic: _Topic, column: str, last: np.ndarray) -> np.ndarray:
    return np.where(last >= 0, topic.column(column)[last], np.nan)


def _main_topic(topics: dict[str, _Topic], layout: LogColumns | None, path: Path) -> str:
    joints = [name for name, topic in topics.items() if topic.kind == _JOINTS]
    if not joints:
        raise DataError(f"the bag has no {_JOINTS}", "record the joint states", source=path)
    chosen = None if layout is None else layout.topic
    if chosen is None and (layout is None or len(joints) == 1):
        return max(joints, key=lambda name: len(topics[name].rows))
    if chosen not in joints:
        problem = (
            "several topics have joint states" if chosen is None else f"there is no topic {chosen} of joint states"
        )
        raise DataError(problem, f"set topic: to one of {', '.join(joints)}", source=path)
    return chosen


def _topics(path: Path) -> dict[str, _Topic]:
    require_package("mcap_ros2", path)
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    topics: dict[str, _Topic] = {}
    remedy = "copy or record it again; mcap recover repairs a truncated bag"
    with unreadable("the bag cannot be read", remedy, source=path), path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        if summary is None:
            raise DataError("the bag has no summary", "it is truncated: mcap recover repairs it", source=path)
        require_plausible_size(sum(chunk.uncompressed_size for chunk in summary.chunk_indexes), path)
        kinds = {channel.topic: summary.schemas.get(channel.schema_id) for channel in summary.channels.values()}
        wanted = [topic for topic, kind in kinds.items() if kind and kind.name in (_JOINTS, _NUMBERS)]
        messages = reader.iter_decoded_messages(topics=wanted) if wanted else []
        for schema, channel, message, content in messages:
            topic = topics.setdefault(channel.topic, _Topic(schema.name if schema else ""))
            topic.received.append(message.log_time)
            topic.stamps.append(_stamp(content, message.log_time))
            topic.rows.append(_values(content, topic.kind, channel.topic, len(topic.rows) + 1, path))
    return topics


def _stamp(content: Any, log_time: int) -> int:
    header = getattr(content, "header", None)
    stamp = 0 if header is None else header.stamp.sec * 1_000_000_000 + header.stamp.nanosec
    return stamp or log_time


def _values(content: Any, kind: str, topic: str, number: int, path: Path) -> dict[str, float]:
    if kind == _NUMBERS:
        return {f"data[{i}]": value for i, value in enumerate(content.data)}
    values: dict[str, float] = {}
    for name in _FIELDS:
        numbers: Sequence[float] = getattr(content, name)
        if len(numbers) not in (0, len(content.name)):
            raise DataError(
                f"message {number} of {topic} has {len(content.name)} joints and {len(numbers)} values of {name}",
                "correct the publisher, or leave the message out",
                source=path,
            )
        values |= {f"{joint}.{name}": number for joint, number in zip(content.name, numbers, strict=False)}
    return values
