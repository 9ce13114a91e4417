"""A finger pair as a folder: exact meshes to load again, and files for printers and simulators.

finger.json         name, cage, parameters, mount, limits, content hash, units
meshes.npz          both surfaces, float64 metres: what `load_finger_pair` reads
report.json         measures and verdict
left.stl, right.stl millimetres, grasp frame
plate.3mf           millimetres, both fingers as they lie on the printer's bed
left.obj, right.obj metres, grasp frame
fingers.urdf, fingers.xml (MJCF) and pieces/*.obj, metres
left_sdf.npz, right_sdf.npz     signed distances, metres
"""

import json
import os
import tempfile
from io import BytesIO
from pathlib import Path

import numpy as np

from codesign_design.build import BuiltFinger
from codesign_design.export.convex import convex_pieces
from codesign_design.export.distance_grid import distance_grid
from codesign_design.export.robots import FingerFiles, mjcf_text, urdf_text
from codesign_design.export.surfaces import obj_text, print_plate, stl_bytes
from codesign_design.finger_pair import FingerPair, TriangleMesh

FORMAT = 1
_UNITS = {
    "meshes.npz": "m",
    "*.stl": "mm",
    "plate.3mf": "mm",
    "*.obj": "m",
    "fingers.urdf": "m, kg",
    "fingers.xml": "m, kg",
    "*_sdf.npz": "m",
}


def save_finger_pair(folder: Path, built: BuiltFinger, *, simulators: bool = True) -> None:
    """Writes the folder, each file in one step and `finger.json` last.

    Args:
        folder: made if missing; files of an earlier finger are replaced.
        built: what to write.
        simulators: URDF, MJCF, convex pieces and distance grids too, which takes about a second.
    """
    pair = built.pair
    sides = (("left", pair.left), ("right", pair.right))
    files: dict[str, str | bytes] = {
        "meshes.npz": _meshes(pair),
        "report.json": built.report.to_json() + "\n",
        "plate.3mf": print_plate(pair),
    }
    for name, mesh in sides:
        files[f"{name}.stl"] = stl_bytes(mesh)
        files[f"{name}.obj"] = obj_text(mesh, name)
    if simulators:
        files |= _simulator_files(pair)
    files["finger.json"] = _description(pair)
    folder.mkdir(parents=True, exist_ok=True)
    for file, content in files.items():
        _write(folder / file, content.encode() if isinstance(content, str) else content)


def load_finger_pair(folder: Path) -> FingerPair:
    """The pair that `save_finger_pair` wrote, equal to the last bit.

    Raises:
        ValueError: not such a folder, another format, or meshes that do not belong to it.
        OSError: cannot be read.
    """
    description = json.loads((folder / "finger.json").read_text())
    if description.get("format") != FORMAT:
        raise ValueError(
            f"{folder} has format {description.get('format')}, expected {FORMAT}; build it again"
        )
    with np.load(folder / "meshes.npz") as arrays:
        left, right = (
            TriangleMesh(arrays[f"{name}_vertices"], arrays[f"{name}_faces"])
            for name in ("left", "right")
        )
    pair = FingerPair(
        description["name"],
        left,
        right,
        description["min_width"],
        description["max_width"],
        description["cage"],
        tuple(description["parameters"]),
        description["mount"],
    )
    if pair.content_hash != description["content_hash"]:
        raise ValueError(
            f"{folder} has meshes of hash {pair.content_hash[:12]}, finger.json names "
            f"{description['content_hash'][:12]}; build it again"
        )
    return pair


def _description(pair: FingerPair) -> str:
    content = {
        "format": FORMAT,
        "name": pair.name,
        "cage": pair.cage,
        "parameters": pair.parameters,
        "mount": pair.mount,
        "min_width": pair.min_width,
        "max_width": pair.max_width,
        "content_hash": pair.content_hash,
        "units": {"min_width": "m", "max_width": "m", **_UNITS},
        "frame": "grasp frame at gap 0: x sideways, y along the opening, z out of the gripper",
    }
    return json.dumps(content, indent=2) + "\n"


def _meshes(pair: FingerPair) -> bytes:
    buffer = BytesIO()
    np.savez_compressed(
        buffer,
        left_vertices=pair.left.vertices,
        left_faces=pair.left.faces,
        right_vertices=pair.right.vertices,
        right_faces=pair.right.faces,
    )
    return buffer.getvalue()


def _simulator_files(pair: FingerPair) -> dict[str, str | bytes]:
    left_pieces = convex_pieces(pair.left)
    right_pieces = [piece.mirrored_y() for piece in left_pieces]
    grid = distance_grid(pair.left)
    files: dict[str, str | bytes] = {}
    fingers = []
    for name, mesh, pieces, distances, outward in (
        ("left", pair.left, left_pieces, grid, 1),
        ("right", pair.right, right_pieces, grid.mirrored_y(), -1),
    ):
        paths = [f"pieces/{name}_{number}.obj" for number in range(len(pieces))]
        for path, piece in zip(paths, pieces, strict=True):
            files[path] = obj_text(piece, Path(path).stem)
        files[f"{name}_sdf.npz"] = distances.npz()
        fingers.append(FingerFiles(name, mesh, f"{name}.obj", paths, outward))
    files["fingers.urdf"] = urdf_text(pair, fingers)
    files["fingers.xml"] = mjcf_text(pair, fingers)
    return files


def _write(path: Path, content: bytes) -> None:
    """In one step: readers see the old content or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(prefix=f".{path.name}-", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        Path(temporary).chmod(0o644)
        Path(temporary).replace(path)
    finally:
        Path(temporary).unlink(missing_ok=True)
