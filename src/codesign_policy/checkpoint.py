"""Checkpoints: everything a training run needs to go on as if it had never stopped.

One file holds the state and the configuration that made it, and replaces its predecessor in one
go, so that an interruption while saving leaves the previous checkpoint whole. The configuration
is repeated beside it as JSON, for people.
"""

import json
import os
import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from codesign_policy.files import replacing, write_text

VERSION = 1
STATE_FILE, CONFIGURATION_FILE = "checkpoint.pt", "configuration.json"


@dataclass(frozen=True)
class Checkpoint:
    """What `load_checkpoint` found.

    Attributes:
        configuration: plain values: presets, sizes, seeds, whatever was saved.
        state: nested dictionaries of tensors, numbers and texts.
    """

    configuration: dict[str, Any]
    state: dict[str, Any]


def save_checkpoint(
    folder: Path, state: Mapping[str, Any], configuration: Mapping[str, Any]
) -> None:
    """Writes a checkpoint into `folder`, over the previous one.

    Args:
        folder: made if missing.
        state: nested dictionaries and lists of tensors, arrays, numbers and texts.
        configuration: of values that JSON knows.
    """
    content = {"version": VERSION, "configuration": dict(configuration), "state": _plain(state)}
    with replacing(folder / STATE_FILE) as temporary, temporary.open("wb") as file:
        torch.save(content, file)
        file.flush()
        os.fsync(file.fileno())
    text = json.dumps({"version": VERSION, **configuration}, indent=2)
    write_text(folder / CONFIGURATION_FILE, text + "\n")


def load_checkpoint(folder: Path) -> Checkpoint:
    """Reads the checkpoint in `folder`; runs no code that a file could hold.

    Raises:
        ValueError: no checkpoint, a damaged one, or one of another version.
    """
    path = folder / STATE_FILE
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise ValueError(f"{folder}: holds no {STATE_FILE}; name the folder of a run") from None
    except (RuntimeError, pickle.UnpicklingError, EOFError) as error:
        reason = str(error).split("\n")[0]
        raise ValueError(f"{path}: cannot be read ({reason}); use another checkpoint") from error
    version = content.get("version") if isinstance(content, dict) else None
    if version != VERSION:
        raise ValueError(
            f"{path}: checkpoint version {version}, this is {VERSION}; use the release that "
            "wrote it, or train anew"
        )
    return Checkpoint(content["configuration"], content["state"])


def require_same_configuration(stored: Mapping[str, Any], mine: Mapping[str, Any]) -> None:
    """Raises: ValueError: a stored configuration differs from this one; names the first value."""
    theirs, ours = _flat(stored), _flat(mine)
    for name in sorted(theirs.keys() | ours.keys()):
        a, b = theirs.get(name, "missing"), ours.get(name, "missing")
        if a != b:
            raise ValueError(
                f"{name} was {a} in the checkpoint and is {b} now: resume with the settings of "
                "the run, or start a new one"
            )


def random_state(generator: np.random.Generator) -> str:
    """State of a generator as text: its integers are too long for most formats."""
    return json.dumps(generator.bit_generator.state)


def restore_random(generator: np.random.Generator, state: str) -> None:
    """Takes over a `random_state`."""
    generator.bit_generator.state = json.loads(state)


def _plain(value: Any) -> Any:
    """Arrays as tensors, so that loading needs to trust no other type."""
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_plain(item) for item in value)
    if isinstance(value, np.ndarray):
        return torch.from_numpy(value)
    return value


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested dictionaries as one, with dotted names; tuples as lists, as JSON has them."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = list(value) if isinstance(value, tuple) else value
    return flat
