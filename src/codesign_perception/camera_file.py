"""The one YAML file of a camera: intrinsics, extrinsics, and how well they were found."""

from __future__ import annotations

import datetime
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from codesign_perception.camera import DISTORTION_MODEL, FRAME, Camera

PARENT = "link_base"


@dataclass(frozen=True)
class Record:
    """How one half of a calibration came about.

    Attributes:
        method: in words, such as "charuco" or "simulated".
        date: ISO 8601, UTC.
        reprojection_error_px: root mean square [px]; None where nothing was measured.
        images: how many were used.
    """

    method: str
    date: str
    reprojection_error_px: float | None = None
    images: int = 0

    @staticmethod
    def now(method: str, error: float | None = None, images: int = 0) -> Record:
        """A record dated now."""
        date = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        return Record(method, date, error, images)


@dataclass(frozen=True)
class CameraFile:
    """A camera and where its numbers come from.

    Attributes:
        camera: its pose is meaningless while `extrinsics` is None.
        intrinsics, extrinsics: their records.
    """

    camera: Camera
    intrinsics: Record
    extrinsics: Record | None = None

    def save(self, path: Path | str) -> None:
        """Writes the file."""
        camera = self.camera
        content: dict[str, Any] = {
            "frame": FRAME,
            "image": {"width": camera.width, "height": camera.height},
            "intrinsics": {
                "matrix": camera.matrix.tolist(),
                "distortion_model": DISTORTION_MODEL,
                "distortion": camera.distortion.tolist(),
                **vars(self.intrinsics),
            },
        }
        if self.extrinsics is not None:
            content["extrinsics"] = {
                "parent": PARENT,
                "position_m": camera.position.tolist(),
                "quaternion_xyzw": camera.quaternion.tolist(),
                **vars(self.extrinsics),
            }
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")

    @staticmethod
    def load(path: Path | str) -> CameraFile:
        """Reads and checks the file.

        Raises:
            OSError: it cannot be read.
            ValueError: it is no camera file; the message names file, entry and what is wrong.
        """
        try:
            content = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise ValueError(f"{path}: not YAML: {' '.join(str(error).split())}") from error
        try:
            return _parsed(content)
        except (KeyError, TypeError, ValueError) as error:
            reason = f"{error.args[0]} is missing" if isinstance(error, KeyError) else error
            raise ValueError(f"{path}: {reason}") from error


def load_camera(path: Path | str) -> Camera:
    """A fully calibrated camera.

    Raises:
        OSError, ValueError: as `CameraFile.load`, or the file holds no extrinsics.
    """
    content = CameraFile.load(path)
    if content.extrinsics is None:
        raise ValueError(
            f"{path}: no extrinsics: run codesign perception calibrate extrinsics (or hand-eye)"
        )
    return content.camera


def save_camera(path: Path | str, camera: Camera, method: str = "simulated") -> None:
    """Writes a camera that nobody had to calibrate."""
    CameraFile(camera, Record.now(method), Record.now(method)).save(path)


def _parsed(content: Any) -> CameraFile:
    content = _section(content, "the file")
    if content.get("frame") != FRAME:
        raise ValueError(f"frame is {content.get('frame')!r}: must be {FRAME}")
    image = _section(content["image"], "image")
    intrinsics = _section(content["intrinsics"], "intrinsics")
    if intrinsics["distortion_model"] != DISTORTION_MODEL:
        raise ValueError(
            f"intrinsics.distortion_model is {intrinsics['distortion_model']!r}: "
            f"must be {DISTORTION_MODEL}"
        )
    lens = Camera(
        image["width"],
        image["height"],
        np.asarray(intrinsics["matrix"], dtype=np.float64),
        np.asarray(intrinsics["distortion"], dtype=np.float64),
    )
    if content.get("extrinsics") is None:
        return CameraFile(lens, _record(intrinsics, "intrinsics"))
    extrinsics = _section(content["extrinsics"], "extrinsics")
    if extrinsics["parent"] != PARENT:
        raise ValueError(f"extrinsics.parent is {extrinsics['parent']!r}: must be {PARENT}")
    camera = lens.moved(extrinsics["position_m"], extrinsics["quaternion_xyzw"])
    return CameraFile(camera, _record(intrinsics, "intrinsics"), _record(extrinsics, "extrinsics"))


def _section(value: Any, name: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{name} is no mapping of names to values")
    return value


def _record(section: dict[str, Any], name: str) -> Record:
    error = section.get("reprojection_error_px")
    if error is not None and not (isinstance(error, int | float) and 0.0 <= error < np.inf):
        raise ValueError(f"{name}.reprojection_error_px is {error!r}: must be a number >= 0")
    images = section.get("images", 0)
    if not isinstance(images, int) or images < 0:
        raise ValueError(f"{name}.images is {images!r}: must be a count")
    error = None if error is None else float(error)
    return Record(str(section["method"]), str(section["date"]), error, images)
