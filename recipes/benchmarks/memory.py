"""Memory of this process: held, peak and available. Linux, or a GPU."""

import ctypes
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import torch


def held(device: str) -> int:
    """Bytes in use: allocated on the GPU, or private to this process (without mapped files)."""
    if torch.device(device).type == "cuda":
        return torch.cuda.memory_allocated(device)
    ctypes.CDLL(None).malloc_trim(0)  # return freed memory to the system first
    return _of_this_process("RssAnon")


def taken_by(call: Callable[[], object], device: str) -> int:
    """Peak bytes that a call adds to those in use."""
    before = held(device)
    if torch.device(device).type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        call()
        return torch.cuda.max_memory_allocated(device) - before
    before = _of_this_process("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # reset the peak
    call()
    return _of_this_process("VmHWM") - before


def _of_this_process(entry: str) -> int:
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.split(f"{entry}:")[1].split()[0])


def room_in_memory() -> int:
    """Bytes that a benchmark may allocate: half of the machine's memory."""
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2


def room_on_disk(folder: str | Path) -> int:
    """Bytes that a benchmark may write: nine tenths of the free disk space."""
    return shutil.disk_usage(folder).free * 9 // 10
