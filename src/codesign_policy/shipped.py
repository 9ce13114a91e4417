"""Trained pairs as folders that come with the package.

checkpoints/<name>/policy.npz   what is served
checkpoints/<name>/finger/      of a pair with a design: STL, 3MF, exact meshes, parameters, report
                                of the build, picture
"""

import os
import shutil
import tempfile
from pathlib import Path

import numpy as np

from codesign_policy.policy_file import TrainedPair

CHECKPOINTS = Path(__file__).parent / "checkpoints"
POLICY, FINGER = "policy.npz", "finger"


def checkpoint_names() -> list[str]:
    """Names of the pairs that come with the package."""
    return sorted(path.parent.name for path in CHECKPOINTS.glob(f"*/{POLICY}"))


def checkpoint_path(name: str | Path) -> Path:
    """The policy file of a shipped pair's name, of a checkpoint folder, or itself.

    Raises:
        ValueError: none of these; lists the names.
    """
    path = Path(name)
    if str(name) in checkpoint_names():
        path = CHECKPOINTS / name
    if path.is_dir():
        path = path / POLICY
    if not path.is_file():
        known = ", ".join(checkpoint_names()) or "none yet"
        raise ValueError(
            f"checkpoint {str(name)!r}: unknown; there are {known}; or give the path of a "
            f"{POLICY} or of its folder"
        )
    return path


def ship(pair: TrainedPair, folder: Path) -> None:
    """Writes a checkpoint folder, over what was there, whole or not at all.

    Args:
        pair: with the design space of its fingers in `about`, if they have one.
        folder: such as `CHECKPOINTS / "codesign"`.

    Raises:
        ValueError: a design without a space or that does not belong to it, or a finger that
            cannot be printed or used.
        OSError: the folder cannot be written.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    part = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        if pair.space:
            _write_finger(pair, folder.name, part / FINGER)
        elif len(pair.design):
            raise ValueError(
                f"a design of {len(pair.design)} numbers, but about names no space: add it"
            )
        pair.save(part / POLICY)
        part.chmod(0o755)
        _replace(part, folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _write_finger(pair: TrainedPair, name: str, folder: Path) -> None:
    """Builds the design as `finger_design` does."""
    from codesign_design.build import build_finger
    from codesign_design.design_file import write_parameters
    from codesign_design.design_space import design_space
    from codesign_design.finger_files import save_finger_pair
    from codesign_design.pictures import design_picture, save

    space, parameters = design_space(pair.space), pair.design.astype(np.float64)
    built = build_finger(space.surface(parameters), name, space.name, parameters.tolist())
    if not built.report.valid:
        raise ValueError(f"finger {name!r} cannot be used: {'; '.join(built.report.problems)}")
    save_finger_pair(folder, built, simulators=False)
    write_parameters(folder / "parameters.json", space, parameters)
    save(design_picture(space, parameters), folder / "finger.png")


def _replace(part: Path, folder: Path) -> None:
    """A folder cannot be renamed over one that is not empty: the old one goes aside first."""
    if not folder.exists():
        os.replace(part, folder)
        return
    old = Path(tempfile.mkdtemp(prefix=f".{folder.name}-old-", dir=folder.parent))
    os.replace(folder, old)
    os.replace(part, folder)
    shutil.rmtree(old, ignore_errors=True)
