"""Replay buffers of the two-stage task, and the batches that mix demonstrations and experience.

A row is one transition of either stage. Its action is [a_D, a_C] with the idle part zero, so that
critics cannot tell demonstrations from experience by numbers without effect. Rewards are kept as
components: changing their weights relabels everything ever stored.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

ACTION_TOLERANCE = 1e-6  # rounding of float32 beyond [-1, 1]


@dataclass(frozen=True)
class Spaces:
    """Sizes of what the two stages observe and do.

    Attributes:
        observation: numbers of o = [p_ee, p_obj, w_ee, f, d].
        design: numbers of a_D; 0 where fingers are given and only control is learned.
        control: numbers of a_C.
    """

    observation: int
    design: int
    control: int

    @property
    def action(self) -> int:
        """Numbers of a = [a_D, a_C]."""
        return self.design + self.control


@dataclass(frozen=True)
class Transitions:
    """N rows, as they are stored.

    Attributes:
        observation, next_observation: (N, o).
        action: [a_D, a_C] in [-1, 1], (N, a).
        in_control: True for the control stage, False for the design stage, (N,).
        components: parts of the reward before weighting, (N, K).
        terminated: the task ended here: nothing follows that could be worth something, (N,).
        truncated: the time limit ended the episode: its value goes on (bootstrap), (N,).
    """

    observation: NDArray[np.float32]
    action: NDArray[np.float32]
    in_control: NDArray[np.bool_]
    components: NDArray[np.float32]
    next_observation: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]

    def pick(self, rows: NDArray[Any] | slice) -> "Transitions":
        """Some of the rows, by mask, number or slice."""
        return Transitions(**{name: getattr(self, name)[rows] for name in FIELDS})


FIELDS = tuple(f.name for f in fields(Transitions))


@dataclass(frozen=True)
class Batch:
    """B rows to learn from, as tensors.

    `weight` makes their weighted mean that of the buffers.
    """

    observation: Tensor
    action: Tensor
    in_control: Tensor
    reward: Tensor
    next_observation: Tensor
    terminated: Tensor
    weight: Tensor


class ReplayBuffer:
    """Rows in preallocated arrays; when full, the oldest are overwritten."""

    def __init__(self, spaces: Spaces, components: Sequence[str], capacity: int) -> None:
        """Args: sizes; names of the reward's components; how many rows it holds.

        Raises:
            ValueError: no component, or no room.
        """
        if not components or capacity < 1:
            raise ValueError(
                f"{len(components)} reward components, capacity {capacity}: give at least one each"
            )
        self.spaces, self.components, self.capacity = spaces, tuple(components), capacity
        self._rows = Transitions(
            observation=np.zeros((capacity, spaces.observation), np.float32),
            action=np.zeros((capacity, spaces.action), np.float32),
            in_control=np.zeros(capacity, np.bool_),
            components=np.zeros((capacity, len(components)), np.float32),
            next_observation=np.zeros((capacity, spaces.observation), np.float32),
            terminated=np.zeros(capacity, np.bool_),
            truncated=np.zeros(capacity, np.bool_),
        )
        self._size = self._next = 0
        self._strata: tuple[NDArray[np.intp], NDArray[np.intp]] | None = None

    def __len__(self) -> int:
        return self._size

    @property
    def rows(self) -> Transitions:
        """Views of all stored rows, in the order of the arrays."""
        return self._rows.pick(slice(self._size))

    @property
    def designs(self) -> NDArray[np.float32]:
        """Every stored design, (n, D), in the order of the arrays."""
        rows = self.rows
        return rows.action[~rows.in_control, : self.spaces.design]

    def insert(self, rows: Transitions) -> None:
        """Appends rows; the part of the action that is idle in a row's stage is set to zero.

        Raises:
            ValueError: wrong shape, a number that is not finite, an active action beyond [-1, 1],
                or more rows than the buffer holds. Nothing is stored then.
        """
        rows = self._checked(rows)
        count = len(rows.in_control)
        where = (self._next + np.arange(count)) % self.capacity
        for name in FIELDS:
            getattr(self._rows, name)[where] = getattr(rows, name)
        self._next = (self._next + count) % self.capacity
        self._size = min(self._size + count, self.capacity)
        self._strata = None

    def reward(
        self, weights: Mapping[str, float], index: NDArray[np.intp] | slice = slice(None)
    ) -> NDArray[np.float32]:
        """Weighted sum of the components of the rows `index`.

        Raises:
            ValueError: weights for other components than the stored ones.
        """
        if set(weights) != set(self.components):
            raise ValueError(
                f"reward weights for {sorted(weights)}: the buffer stores {sorted(self.components)}"
            )
        vector = np.array([weights[name] for name in self.components], np.float32)
        return self.rows.components[index] @ vector

    def draw(
        self, count: int, design_count: int, random: np.random.Generator
    ) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
        """Draws rows with replacement, `design_count` of them from the design stage.

        One row in hundreds is of the design stage, so most uniform batches would teach nothing
        about designs. Importance weights (share in the buffer over share in the draw) keep every
        weighted mean unbiased. A buffer of one stage alone is drawn from uniformly.

        Returns:
            Row numbers (count,) and weights (count,).

        Raises:
            ValueError: the buffer is empty, or the design rows leave no room for control.
        """
        if not self._size or not 0 <= design_count < count:
            raise ValueError(
                f"{count} rows, {design_count} of the design stage, of {self._size} stored: store "
                "rows first, and ask for fewer design rows than rows"
            )
        design, control = self._stage_rows()
        if not len(design) or not len(control) or not design_count:
            return random.integers(self._size, size=count), np.ones(count, np.float32)
        control_count = count - design_count
        index = np.concatenate(
            [
                design[random.integers(len(design), size=design_count)],
                control[random.integers(len(control), size=control_count)],
            ]
        )
        share = len(design) / self._size
        weight = np.repeat(
            np.array([share / design_count, (1.0 - share) / control_count]) * count,
            [design_count, control_count],
        )
        return index, weight.astype(np.float32)

    def state(self) -> dict[str, Any]:
        """Everything that `restore` needs, as copies."""
        arrays = {name: getattr(self.rows, name).copy() for name in FIELDS}
        names = list(self.components)
        return {**arrays, "next": self._next, "capacity": self.capacity, "components_order": names}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Takes over a `state()`.

        Raises:
            ValueError: rows of other shapes, components or capacity than this buffer's.
        """
        mine = {"capacity": self.capacity, "components_order": list(self.components)}
        for name, value in mine.items():
            if state[name] != value:
                raise ValueError(f"stored {name} {state[name]}: this buffer's is {value}")
        rows = self._checked(Transitions(*(np.asarray(state[name]) for name in FIELDS)))
        self._size, self._next = len(rows.in_control), int(state["next"])
        for name in FIELDS:
            getattr(self._rows, name)[: self._size] = getattr(rows, name)
        self._strata = None

    def _stage_rows(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Numbers of the design rows and of the control rows."""
        if self._strata is None:
            in_control = self.rows.in_control
            self._strata = np.flatnonzero(~in_control), np.flatnonzero(in_control)
        return self._strata

    def _checked(self, rows: Transitions) -> Transitions:
        """The rows in the buffer's types, idle actions zeroed."""
        count = len(rows.in_control)
        if count > self.capacity:
            raise ValueError(f"{count} rows: the buffer holds {self.capacity}; make it larger")
        arrays = {}
        for name in FIELDS:
            mine, array = getattr(self._rows, name), np.asarray(getattr(rows, name))
            if array.shape != (count, *mine.shape[1:]):
                raise ValueError(
                    f"{name} has shape {array.shape}; it must be {(count, *mine.shape[1:])}"
                )
            if mine.dtype == np.bool_ and array.dtype != np.bool_:
                raise ValueError(f"{name} is of type {array.dtype}; it must be bool")
            arrays[name] = array.astype(mine.dtype)
        split = self.spaces.design
        arrays["action"][arrays["in_control"], :split] = 0.0
        arrays["action"][~arrays["in_control"], split:] = 0.0
        for name, array in arrays.items():
            _require_finite(name, array)
        largest = np.abs(arrays["action"]).max(initial=0.0)
        if largest > 1.0 + ACTION_TOLERANCE:
            raise ValueError(f"action reaches {largest}; scale actions to [-1, 1]")
        return Transitions(**arrays)


def joined(like: ReplayBuffer, *parts: Transitions) -> ReplayBuffer:
    """A full buffer of these rows, with the sizes and components of another."""
    count = sum(len(part.in_control) for part in parts)
    buffer = ReplayBuffer(like.spaces, like.components, count)
    for part in parts:
        buffer.insert(part)
    return buffer


def sample_batch(
    buffers: Sequence[ReplayBuffer],
    size: int,
    design_rows: int,
    weights: Mapping[str, float],
    random: np.random.Generator,
) -> Batch:
    """The same number of rows from each buffer: RLPD's symmetric sampling (section 4.1).

    Args:
        buffers: demonstrations and experience in this order, or experience alone.
        size: of the batch; a multiple of the number of buffers.
        design_rows: how many of them are of the design stage, likewise.
        weights: of the reward's components.
        random: draws the rows.

    Raises:
        ValueError: sizes that do not divide, or what `ReplayBuffer.draw` and `reward` refuse.
    """
    shares = len(buffers)
    if not shares or size % shares or design_rows % shares:
        raise ValueError(
            f"{size} rows, {design_rows} of the design stage, from {shares} buffers: use multiples"
        )
    parts: dict[str, list[NDArray[Any]]] = {f.name: [] for f in fields(Batch)}
    for buffer in buffers:
        index, weight = buffer.draw(size // shares, design_rows // shares, random)
        rows = buffer.rows
        for name in FIELDS:
            if name in parts:
                parts[name].append(getattr(rows, name)[index])
        parts["reward"].append(buffer.reward(weights, index))
        parts["weight"].append(weight)
    return Batch(**{name: torch.from_numpy(np.concatenate(part)) for name, part in parts.items()})


def _require_finite(name: str, array: NDArray[Any]) -> None:
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        where = tuple(int(i) for i in bad[0])
        raise ValueError(f"{name}{list(where)} is {array[where]}; every value must be finite")
