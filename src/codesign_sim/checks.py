"""Checks of arguments: an error names the value, the limit and the remedy."""

from __future__ import annotations

from typing import Any

import numpy as np


class SimulationError(RuntimeError):
    """The simulation left the range it is valid in (a state that is not finite)."""


def require_finite(name: str, value: Any, shape: tuple[int, ...], unit: str = "") -> np.ndarray:
    """`value` as a float64 array of `shape`; -1 in `shape` allows any length there.

    Raises:
        ValueError: wrong shape, not numbers, or not finite.
    """
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be numbers of shape {shape}, got {value!r}") from error
    fits = array.ndim == len(shape) and all(
        want in (-1, have) for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise ValueError(f"{name} has shape {array.shape}; it must be {shape}")
    if not np.isfinite(array).all():
        bad = array[~np.isfinite(array)].flat[0]
        raise ValueError(f"{name} contains {bad}; every value must be finite{_in(unit)}")
    return array


def require_positive(name: str, value: Any, shape: tuple[int, ...], unit: str = "") -> np.ndarray:
    """Like `require_finite`, and every value above zero."""
    array = require_finite(name, value, shape, unit)
    if (array <= 0).any():
        raise ValueError(f"{name} is {array.min():g}{_in(unit)}; it must be above 0")
    return array


def require_not_negative(name: str, value: Any, unit: str = "") -> float:
    """A finite number of at least zero."""
    number = float(require_finite(name, value, (), unit))
    if number < 0:
        raise ValueError(f"{name} is {number:g}{_in(unit)}; it must be at least 0")
    return number


def require_per_environment(
    name: str, value: Any, environments: int, shape: tuple[int, ...], unit: str = ""
) -> np.ndarray:
    """`value` of `shape`, the same for all, or (environments, *shape), as the latter."""
    full = (environments, *shape)
    array = np.asarray(value, dtype=np.float64)
    if array.shape == shape:
        array = np.broadcast_to(array, full)
    return require_finite(name, array, full, unit)


def require_integers(name: str, value: Any, shape: tuple[int, ...], least: int) -> np.ndarray:
    """Like `require_finite`, and every value a whole number of at least `least`."""
    array = require_finite(name, value, shape)
    if (array != np.round(array)).any() or (array < least).any():
        raise ValueError(f"{name} is {array.tolist()}; use whole numbers of at least {least}")
    return array.astype(int)


def _in(unit: str) -> str:
    return f" {unit}" if unit else ""
