"""Tolerances of the readers, as one documented settings object."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ReaderSettings:
    """Tolerances for clocks and bounds in measured data.

    The tolerance for single irregular time steps is :attr:`LogColumns.time_tolerance`, because it depends on the log.

    Args:
        clock_tolerance: share of dt by which the typical time step of a log may differ from the declared dt. Clock
            drift is smaller; the difference is larger in logs from which every n-th row was removed.
        longest_regular_step: multiple of the median time step; longer steps are gaps and are excluded from the mean.
        stale_rows: resampling takes up to this many rows in sequence with the readings of the row before for the
            effect of lost packets; in longer stretches, the robot rests.
        bound_rounding: share of an action bound by which an action may exceed it. A recording in float64 that is
            rounded to float32 exceeds it by about 1e-7.
        largest_compression: ratio of the bytes that an array states to those that its file stores, above which the
            file is refused; deflate reaches 1032 for constant values.
        largest_expansion: ratio of the bytes of a log's values to those of its compressed file, above which the file
            is refused.
        unsuspicious_bytes: logs that state fewer bytes are read whatever their compression.
        layout_bytes: largest size of a column description in bytes.
        layout_entries: largest number of entries in a column description after its aliases are expanded.
    """

    clock_tolerance: float = 0.02
    longest_regular_step: float = 2.0
    stale_rows: int = 10
    bound_rounding: float = 1e-6
    largest_compression: float = 1100.0
    largest_expansion: float = 200.0
    unsuspicious_bytes: int = 2**26
    layout_bytes: int = 2**20
    layout_entries: int = 20_000


READER_SETTINGS = ReaderSettings()
