"""What the figures were measured on."""

from __future__ import annotations

import os
import platform
from pathlib import Path

from codesign_sim.block import Block
from codesign_sim.layout import Layout

_CPU_INFO = Path("/proc/cpuinfo")
_MANY = 64  # environments that surely fill a vector
# From the widest down; the first one that the processor names is the one used.
_INSTRUCTION_SETS = {"avx512f": "AVX-512", "avx2": "AVX2", "avx": "AVX", "asimd": "NEON"}


def full_lanes() -> int:
    """Environments that fill a SIMD vector of this machine."""
    return Layout(Block.tofu(600), _MANY).lanes


def describe_machine() -> dict[str, object]:
    """Processor, its cores for this process, instruction set and lanes; GPU if Warp finds one."""
    import warp as wp

    info = _CPU_INFO.read_text() if _CPU_INFO.exists() else ""
    flags = set(_field(info, "flags").split()) | set(_field(info, "Features").split())
    sets = [name for flag, name in _INSTRUCTION_SETS.items() if flag in flags]
    gpus = [device.name for device in wp.get_cuda_devices()]
    return {
        "cpu": _field(info, "model name") or platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "instruction_set": sets[0] if sets else platform.machine(),
        "lanes": full_lanes(),
        "load_average": os.getloadavg()[0],
        "gpu": gpus[0] if gpus else None,
    }


def _field(info: str, name: str) -> str:
    """The first value of a field of /proc/cpuinfo, "" where there is none."""
    for line in info.splitlines():
        key, _, value = line.partition(":")
        if key.strip() == name:
            return value.strip()
    return ""
