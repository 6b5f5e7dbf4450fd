"""How much memory this process holds, takes at its height, and may take. Linux, or a GPU."""

import ctypes
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import torch


def held(device: str) -> int:
    """Bytes that cannot be given back: of the GPU, or this process's own, without the pages of mapped files."""
    if torch.device(device).type == "cuda":
        return torch.cuda.memory_allocated(device)
    ctypes.CDLL(None).malloc_trim(0)  # what was freed goes back
    return _of_this_process("RssAnon")


def taken_by(call: Callable[[], object], device: str) -> int:
    """Bytes that a call adds to what is held, at its height."""
    before = held(device)
    if torch.device(device).type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        call()
        return torch.cuda.max_memory_allocated(device) - before
    before = _of_this_process("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # forget the height so far
    call()
    return _of_this_process("VmHWM") - before


def _of_this_process(entry: str) -> int:
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.split(f"{entry}:")[1].split()[0])


def room_in_memory() -> int:
    """Bytes that a benchmark may take: half of what the machine has."""
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2


def room_on_disk(folder: str | Path) -> int:
    """Bytes that a benchmark may write: nine tenths of what is free."""
    return shutil.disk_usage(folder).free * 9 // 10
