"""Compiles the kernels ahead of the first use."""

from __future__ import annotations

from collections.abc import Callable

import warp as wp

from codesign_sim import kernels, surface_queries

_PARTS = {"simulation kernels": kernels, "distance grids": surface_queries}


def warm_up(progress: Callable[[str, int, int], None] | None = None) -> None:
    """Compiles every kernel for this machine; Warp keeps them in its cache directory.

    Args:
        progress: called with (what, parts done, parts in all) before each part and at the end.
    """
    for done, (name, module) in enumerate(_PARTS.items()):
        if progress is not None:
            progress(name, done, len(_PARTS))
        wp.load_module(module, device="cpu")
    if progress is not None:
        progress("done", len(_PARTS), len(_PARTS))
