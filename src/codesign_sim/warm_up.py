"""Compiles the kernels ahead of the first use."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import warp as wp

from codesign_sim import surface_queries
from codesign_sim.kernels import kernels, vector_lanes


def warm_up(progress: Callable[[str, int, int], None] | None = None) -> None:
    """Compiles every kernel for this machine; Warp keeps them in its cache directory.

    Args:
        progress: called with (what, parts done, parts in all) before each part and at the end.
    """
    parts: dict[str, Any] = {"one environment": kernels(1).module}
    parts |= {f"{lanes} environments": kernels(lanes).module for lanes in vector_lanes()}
    parts["distance grids"] = surface_queries
    for done, (name, module) in enumerate(parts.items()):
        if progress is not None:
            progress(name, done, len(parts))
        wp.load_module(module, device="cpu")
    if progress is not None:
        progress("done", len(parts), len(parts))
