"""A trained pair as one small file: the control actor's weights and the design it was trained for.

Reading it runs no code and needs no torch, so that a node that serves it starts fast.
"""

import io
import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codesign_policy.files import replacing
from codesign_policy.task import ENCODED, TASK_VERSION, encoded

VERSION = 1


@dataclass(frozen=True)
class TrainedPair:
    """A control policy and its design.

    Attributes:
        weights: of each layer, (in, out).
        biases: of each layer, (out,); the last layer answers means and log spreads.
        design: (D,) in [-1, 1]; empty where the fingers were given.
        about: where it comes from, plain values; "space" names the design space of its fingers,
            empty or missing for the stock fingers; "encoding" says whether the first layer takes
            the encoded observation (`task.encoded`).
    """

    weights: tuple[NDArray[np.float32], ...]
    biases: tuple[NDArray[np.float32], ...]
    design: NDArray[np.float32]
    about: dict[str, Any]

    @property
    def space(self) -> str:
        """Design space of its fingers; empty for the stock fingers."""
        return str(self.about.get("space", ""))

    @property
    def encoding(self) -> bool:
        """Whether the network sees observations encoded."""
        return bool(self.about.get("encoding", False))

    @property
    def observation_size(self) -> int:
        """Numbers of an observation."""
        return self.weights[0].shape[0] - (ENCODED if self.encoding else 0)

    @property
    def control_size(self) -> int:
        """Numbers of a control action."""
        return self.weights[-1].shape[1] // 2

    def act(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        """The actor's mean action (n, 7) in [-1, 1] for normalised observations (n, o)."""
        x = encoded(observation) if self.encoding else np.asarray(observation, np.float32)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = np.maximum(x @ weight + bias, 0.0)
        last = x @ self.weights[-1] + self.biases[-1]
        return np.tanh(last[..., : self.control_size])

    def save(self, path: Path) -> None:
        """Writes the pair to `path` (.npz), over what was there, in one go."""
        count = range(len(self.weights))
        arrays: dict[str, NDArray[Any]] = {f"weight_{k}": self.weights[k] for k in count}
        arrays |= {f"bias_{k}": self.biases[k] for k in count}
        versions = {"version": VERSION, "task_version": TASK_VERSION}
        about = json.dumps({**self.about, **versions, "layers": len(self.weights)})
        arrays |= {"design": self.design, "about": np.array(about)}
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]


def load_pair(path: Path) -> TrainedPair:
    """Reads a trained pair.

    Raises:
        ValueError: no such file, a damaged one, another version of file or task, or layers that
            do not fit.
    """
    return read_pair(pair_bytes(path), path)


def pair_bytes(path: Path) -> bytes:
    """What the file of a trained pair holds.

    Raises:
        ValueError: it cannot be read.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise ValueError(
            f"{path}: not a trained pair ({error}); name a file that an export has written"
        ) from error


def read_pair(content: bytes, path: Path) -> TrainedPair:
    """A trained pair from what its file holds; `path` is for messages.

    Raises:
        ValueError: as `load_pair`.
    """
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            about = json.loads(str(file["about"]))
            layers = range(about.pop("layers"))
            weights = tuple(file[f"weight_{k}"] for k in layers)
            biases = tuple(file[f"bias_{k}"] for k in layers)
            design = file["design"]
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(
            f"{path}: not a trained pair ({error}); name a file that an export has written"
        ) from error
    for name, ours in (("version", VERSION), ("task_version", TASK_VERSION)):
        theirs = about.pop(name, None)
        if theirs != ours:
            raise ValueError(
                f"{path}: {name} is {theirs}, this program's is {ours}; train and export it anew"
            )
    _check(path, weights, biases, design)
    return TrainedPair(weights, biases, design, about)


def _check(
    path: Path,
    weights: tuple[NDArray[Any], ...],
    biases: tuple[NDArray[Any], ...],
    design: NDArray[Any],
) -> None:
    size = weights[0].shape[0]
    for k, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        if weight.shape != (size, len(bias)):
            raise ValueError(
                f"{path}: layer {k} has shape {weight.shape}, its neighbours need "
                f"{(size, len(bias))}; export it anew"
            )
        size = len(bias)
    if not all(np.isfinite(array).all() for array in (*weights, *biases, design)):
        raise ValueError(f"{path}: holds numbers that are not finite; export another checkpoint")
