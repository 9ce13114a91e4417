"""Cages: closed triangle meshes whose vertices are the handles of a deformation.

Cages are data: one JSON file each in `cages/`, with a version that changes when its handles do, so
that stored design parameters keep their meaning.
"""

import json
from dataclasses import dataclass
from functools import cache
from importlib import resources

import numpy as np
from numpy.typing import NDArray

_FOLDER = resources.files("codesign_design") / "cages"


@dataclass(frozen=True)
class Cage:
    """A rest cage around a base mesh, in that mesh's unit space.

    Attributes:
        name: base mesh and number of handles, e.g. "sphere-7".
        version: changes whenever handles or faces do.
        handles: (N, 3) float64.
        faces: (F, 3) int32, counter-clockwise seen from outside.
    """

    name: str
    version: int
    handles: NDArray[np.float64]
    faces: NDArray[np.int32]


def cage_names() -> list[str]:
    """Every cage there is: base meshes in alphabetical order, fewer handles first."""
    names = [file.name.removesuffix(".json") for file in _FOLDER.iterdir()]
    return sorted(
        (name for name in names if name.rpartition("-")[2].isdigit()),
        key=lambda name: (name.rpartition("-")[0], int(name.rpartition("-")[2])),
    )


@cache
def load_cage(name: str) -> Cage:
    """The cage of that name.

    Raises:
        ValueError: no such cage.
    """
    if name not in cage_names():
        raise ValueError(f"no cage {name!r}; choose from {', '.join(cage_names())}")
    data = json.loads((_FOLDER / f"{name}.json").read_text())
    return Cage(
        name,
        data["version"],
        np.array(data["handles"], dtype=np.float64),
        np.array(data["faces"], dtype=np.int32),
    )
