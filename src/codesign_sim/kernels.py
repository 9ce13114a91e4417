"""The Warp kernels: what native/fem.h computes, launched once per group of environments."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import warp as wp

# Warp reports itself on standard output, where a command's JSON belongs.
wp.config.log_level = 40


def _start_warp() -> None:
    """Starts Warp; on machines without a GPU driver, without its warning that there is none."""
    with contextlib.suppress(OSError):
        ctypes.CDLL("libcuda.so.1")
        wp.init()
        return
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)  # the warning comes from native code
        wp.init()
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


_start_warp()

_NATIVE = Path(__file__).parent / "native"
_HEADERS = ["vec3.h", "team.h", "lanes.h", "elements.h", "contact.h", "fem.h"]
_CPU_INFO = Path("/proc/cpuinfo")

# Modes of the kernels, the L of native/lanes.h. With 1 a vector holds neighbouring items of one
# environment, with 8 or 16 it holds as many environments, and in a team the threads of a CUDA block
# share the items of one environment.
TEAM = 0
ITEM_LANES, TEAM_LANES = 8, 32  # items side by side in memory with 1 and with TEAM
_FEWEST = {16: 9, 8: 4}  # environments from which on so many lanes are the fastest
_BLOCK = 128  # threads of a team on CUDA

# Order of the settings array, as in native/contact.h.
SETTINGS = (
    "substeps",
    "time_step",
    "stiffness_damping",
    "mass_damping",
    "damp_about_rigid",
    "gravity_x",
    "gravity_y",
    "gravity_z",
    "top_speed",
    "contact_stiffness",
    "obstacle_bits",
    "fraction",
    "fraction_step",
    "finger_speed",
    "contact_skin",
)


def _options() -> dict[str, Any]:
    return {
        "enable_backward": False,
        # Warp leaves out fused multiply-adds, and compilers halve vectors of 16 on some machines.
        "cpu_compiler_flags": "-march=native -ffp-contract=fast -mprefer-vector-width=512",
        "extra_build_options": wp.ModuleBuildOptions(
            extra_cpu_include_dirs=[str(_NATIVE)],
            extra_cpu_preamble='#include "fem.h"\n',
            extra_cuda_include_dirs=[str(_NATIVE)],
            extra_cuda_preamble='#include "fem.h"\n',
            extra_build_dependencies=[str(_NATIVE / name) for name in _HEADERS],
        ),
    }


@wp.struct
class Scene:
    """All arrays of a simulation; layouts are [group][item][component][lane], see lanes.h."""

    threads: wp.int32  # per group
    groups: wp.int32
    tet_items: wp.int32
    triangle_items: wp.int32
    node_items: wp.int32
    node_rows: wp.int32
    settings: wp.array[wp.float32]
    # the block
    tet_nodes: wp.array[wp.int32]
    tet_shapes: wp.array[wp.float32]
    triangle_nodes: wp.array[wp.int32]
    triangle_areas: wp.array[wp.float32]
    node_order: wp.array[wp.int32]
    node_constants: wp.array[wp.float32]
    corner_starts: wp.array[wp.int32]
    corners: wp.array[wp.int32]
    # per environment
    materials: wp.array[wp.float32]
    grids: wp.array[wp.float32]
    grid_frames: wp.array[wp.float32]
    grid_indices: wp.array[wp.int32]
    motions: wp.array[wp.float32]
    # state
    positions: wp.array[wp.float32]
    velocities: wp.array[wp.float32]
    ahead: wp.array[wp.float32]
    forces: wp.array[wp.float32]
    corner_forces: wp.array[wp.float32]
    loads: wp.array[wp.float32]
    centres: wp.array[wp.float32]
    anchors: wp.array[wp.float32]
    near_obstacle: wp.array[wp.int32]
    # results
    reports: wp.array[wp.float32]
    stresses: wp.array[wp.float32]


@dataclass(frozen=True)
class Kernels:
    """Compiled for one mode, each launched with `threads` threads per group of environments.

    Attributes:
        advance: all substeps of one advance.
        stress: von Mises stress of every tetrahedron, both measures.
        elastic: elastic node forces at the present positions, into `forces`.
    """

    module: wp.Module
    advance: wp.Kernel
    stress: wp.Kernel
    elastic: wp.Kernel


@cache
def kernels(mode: int) -> Kernels:
    """The kernels of a mode, in a module of their own: only what is used gets compiled."""
    module = wp.get_module(f"{__name__}.mode{mode}")
    wp.set_module_options(_options(), module)
    made = [_kernel(module, name, mode) for name in ("advance", "stress", "elastic")]
    return Kernels(module, *made)


def _kernel(module: wp.Module, name: str, mode: int) -> wp.Kernel:
    def call(scene: Scene, group: int): ...

    def run(scene: Scene):
        native(scene, wp.tid() // scene.threads)  # type: ignore

    call.__name__ = call.__qualname__ = f"_{name}{mode}"
    native = wp.func_native(f"codesign::{name}<{mode}>(scene, group);")(call)
    return wp.kernel(run, name=f"{name}{mode}", module=module)


def threads(device: wp.Device) -> int:
    """Threads that share one group of environments on a device."""
    return _BLOCK if device.is_cuda else 1


def mode_for(environments: int, device: wp.Device) -> int:
    """The fastest mode for a number of environments on a device."""
    if device.is_cuda:
        return TEAM
    return next((n for n in vector_lanes() if environments >= _FEWEST[n]), 1)


@cache
def vector_lanes() -> tuple[int, ...]:
    """Environments per vector that this machine's registers hold, widest first."""
    wide = _CPU_INFO.exists() and " avx512f " in _CPU_INFO.read_text()
    return (16, 8) if wide else (8,)


def find_device(name: str) -> wp.Device:
    """The device of that name.

    Raises:
        ValueError: neither "cpu" nor a CUDA device that is there.
    """
    if name != "cpu" and name.partition(":")[0] != "cuda":
        raise ValueError(f"device is {name!r}; use 'cpu' or 'cuda'")
    found = ["cpu", *(str(device) for device in wp.get_cuda_devices())]
    if name not in found and not (name == "cuda" and len(found) > 1):
        raise ValueError(f"no CUDA device {name!r} found, there is {found}; use device='cpu'")
    return wp.get_device(name)


def record(kernel: wp.Kernel, scene: Any, device: wp.Device) -> Any:
    """A launch over all groups that can be repeated cheaply with `.launch()`."""
    size = scene.groups * scene.threads
    return wp.launch(
        kernel, size, inputs=[scene], device=device, record_cmd=True, block_dim=scene.threads
    )
