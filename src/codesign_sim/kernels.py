"""The Warp kernels: what native/fem.h computes, launched once per group of environments."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import warp as wp

# Warp reports itself on standard output, where a command's JSON belongs.
wp.config.log_level = 40

_NATIVE = Path(__file__).parent / "native"
_HEADERS = ["vec3.h", "team.h", "lanes.h", "elements.h", "contact.h", "fem.h"]

# Environments per vector that the kernels are compiled for. With 1 a vector holds neighbouring
# items of one environment, with 8 it holds eight environments.
LANES = (1, 8)
ITEM_LANES = 8  # as in native/lanes.h

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
    "finger_speed",
    "contact_skin",
)

wp.set_module_options(
    {
        "enable_backward": False,
        # Contraction to fused multiply-adds, which Warp's default leaves out.
        "cpu_compiler_flags": "-march=native -ffp-contract=fast -mprefer-vector-width=512",
        "extra_build_options": wp.ModuleBuildOptions(
            extra_cpu_include_dirs=[str(_NATIVE)],
            extra_cpu_preamble='#include "fem.h"\n',
            extra_build_dependencies=[str(_NATIVE / name) for name in _HEADERS],
        ),
    }
)


@wp.struct
class Scene:
    """All arrays of a simulation; layouts are [group][item][component][lane], see lanes.h."""

    lanes: wp.int32
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
    poses: wp.array[wp.float32]
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


def _for_each_lane_count(call: str) -> str:
    cases = " else ".join(f"if (scene.lanes == {n}) codesign::{call}" % n for n in LANES)
    return cases


@wp.func_native(_for_each_lane_count("advance<%d>(scene, group);"))
def _advance(scene: Scene, group: int): ...


@wp.func_native(_for_each_lane_count("stress<%d>(scene, group);"))
def _stress(scene: Scene, group: int): ...


@wp.func_native(_for_each_lane_count("elastic<%d>(scene, group);"))
def _elastic(scene: Scene, group: int): ...


@wp.kernel
def advance_kernel(scene: Scene):
    """All substeps of one advance, for one group."""
    _advance(scene, wp.tid())


@wp.kernel
def stress_kernel(scene: Scene):
    """Von Mises stress of every tetrahedron of one group, both measures."""
    _stress(scene, wp.tid())


@wp.kernel
def elastic_kernel(scene: Scene):
    """Elastic node forces of one group at its present positions, into `forces`."""
    _elastic(scene, wp.tid())


def record(kernel: Any, scene: Any) -> Any:
    """A launch over all groups that can be repeated cheaply with `.launch()`."""
    return wp.launch(kernel, dim=scene.groups, inputs=[scene], device="cpu", record_cmd=True)
