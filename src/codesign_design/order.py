"""One order for a finger pair, from parameters, a demonstrated surface or an expert's name."""

import json
import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from codesign_design.build import BuiltFinger, build_finger
from codesign_design.design_file import write_parameters, write_stl, write_text
from codesign_design.design_space import design_space
from codesign_design.experts import expert_names, expert_surface
from codesign_design.finger_files import save_finger_pair
from codesign_design.finger_pair import FingerPair, TriangleMesh, check_surface
from codesign_design.inverse import FitOptions, fit
from codesign_design.mesh_checks import edge_checks
from codesign_design.stock import stock_fingers

DEFAULT_CAGE = "sphere-7"
AS_IT_IS = "none"  # instead of a cage: the target itself, without a fit
MAX_NAME = 100  # characters


@dataclass(frozen=True)
class DesignOrder:
    """What is wanted: exactly one of parameters, target, or an expert's name.

    Attributes:
        name: for people; without parameters and target, one of `expert_names()`.
        cage: a design space, empty for "sphere-7"; "none" takes the target as it is.
        parameters: design action a_D, 3 numbers per handle.
        target: demonstrated left finger in the grasp frame [m].
        seed: of the inverse design's restarts.
    """

    name: str = ""
    cage: str = ""
    parameters: tuple[float, ...] = ()
    target: TriangleMesh | None = None
    seed: int = 0


@dataclass(frozen=True)
class DesignDelivery:
    """A pair that can be printed and used, the report that says so (JSON), and its files."""

    pair: FingerPair
    report: str
    files: tuple[Path, ...]


def deliver(
    order: DesignOrder, folder: Path, progress: Callable[[float], None] = lambda share: None
) -> DesignDelivery:
    """Makes the pair and writes its files to a folder of its own, named by the content hash.

    Args:
        folder: of all deliveries; made if missing.
        progress: told the share of an inverse design that is done, 0 to 1.

    Raises:
        ValueError: an order that makes no sense, or a finger that cannot be printed or used;
            nothing is written then.
        OSError: the folder cannot be written.
    """
    if len(order.name) > MAX_NAME or not order.name.isprintable():
        raise ValueError(f"name has {len(order.name)} characters: at most {MAX_NAME}, printable")
    if order.target is not None:
        check_surface(order.target, "target")
        if not all(edge_checks(order.target.faces)):
            raise ValueError(
                "target is not closed: every edge must border two triangles of the same winding; "
                "merge equal vertices and close its holes"
            )
    cage, parameters, surface = _shape(order, progress)
    if surface is None:
        pair = stock_fingers()
        report = json.dumps({"name": pair.name, "valid": True, "content_hash": pair.content_hash})
        return DesignDelivery(
            pair, report, _write(pair, lambda part: _save_stock(part, report), folder)
        )
    name = order.name or (cage if cage else "finger")
    built = build_finger(surface, name, cage, parameters)
    if not built.report.valid:
        raise ValueError(f"finger {name!r} cannot be used: {'; '.join(built.report.problems)}")
    report = built.report.to_json()
    return DesignDelivery(
        built.pair, report, _write(built.pair, lambda part: _save(part, built), folder)
    )


def _shape(
    order: DesignOrder, progress: Callable[[float], None]
) -> tuple[str, tuple[float, ...], TriangleMesh | None]:
    """Cage, parameters and raw surface; None for the stock finger, which has no raw surface."""
    if order.target is not None and order.parameters:
        raise ValueError("parameters and a target are given: leave one of them out")
    if order.target is None and not order.parameters:
        if order.name not in expert_names():
            raise ValueError(
                f"neither parameters nor a target are given, and name {order.name!r} is no "
                f"expert's: there are {', '.join(expert_names())}"
            )
        return "", (), None if order.name == "stock" else expert_surface(order.name)
    if order.target is not None and order.cage == AS_IT_IS:
        return "", (), order.target
    space = design_space(order.cage or DEFAULT_CAGE)
    if order.target is not None:
        found = fit(space, order.target, FitOptions(seed=order.seed), progress=progress)
        return space.name, tuple(map(float, found.parameters)), space.surface(found.parameters)
    return space.name, order.parameters, space.surface(order.parameters)


def _save(folder: Path, built: BuiltFinger) -> None:
    """What a printer and `load_finger_pair` need; those for other simulators take much longer."""
    pair = built.pair
    save_finger_pair(folder, built, simulators=False)
    if pair.cage:
        space = design_space(pair.cage)
        write_parameters(folder / "parameters.json", space, np.array(pair.parameters))


def _save_stock(folder: Path, report: str) -> None:
    pair = stock_fingers()
    write_stl(folder / "left.stl", pair.left)
    write_stl(folder / "right.stl", pair.right)
    write_text(folder / "report.json", report + "\n")


def _write(pair: FingerPair, save: Callable[[Path], None], folder: Path) -> tuple[Path, ...]:
    """Files of a pair; the folder is there with all of them or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    final = folder.resolve() / pair.content_hash[:16]
    if not final.exists():
        part = Path(tempfile.mkdtemp(prefix=".part-", dir=folder))
        try:
            save(part)
            part.chmod(0o755)
            os.replace(part, final)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    return tuple(sorted(final.iterdir()))
