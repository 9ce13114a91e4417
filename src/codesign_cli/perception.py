"""`codesign perception`: calibrate the camera, find the block in a picture, measure how well."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from codesign_perception.board import CharucoBoard, View

app = typer.Typer(help="Camera calibration and the pose of the block.", no_args_is_help=True)
calibrate = typer.Typer(help="Calibrate the camera from pictures of a ChArUco board.")
app.add_typer(calibrate, name="calibrate")

Json = Annotated[bool, typer.Option("--json", help="One JSON object instead of a table.")]
Images = Annotated[list[Path], typer.Argument(help="Pictures.", exists=True, dir_okay=False)]
CameraPath = Annotated[
    Path, typer.Option("--camera", help="Camera file.", exists=True, dir_okay=False)
]
Out = Annotated[Path, typer.Option(help="Camera file to write.")]
Columns = Annotated[int, typer.Option(help="Squares of the board, across.")]
Rows = Annotated[int, typer.Option(help="Squares of the board, down.")]
Square = Annotated[float, typer.Option(help="Edge of a square as printed [m].")]
Marker = Annotated[float, typer.Option(help="Edge of a marker as printed [m].")]
MaxError = Annotated[float, typer.Option(help="Reprojection error that is still accepted [px].")]


@app.command()
def board(
    out: Annotated[Path, typer.Option(help="File to write: .pdf (true to scale) or .png.")],
    columns: Columns = 9,
    rows: Rows = 6,
    square: Square = 0.030,
    marker: Marker = 0.022,
) -> None:
    """Draw the board to print. Print at 100 %, glue it onto something flat, measure a square."""
    made = _board(columns, rows, square, marker)
    if out.suffix not in (".pdf", ".png"):
        raise typer.BadParameter(f"{out}: must end in .pdf or .png", param_hint="--out")
    out.parent.mkdir(parents=True, exist_ok=True)
    if out.suffix == ".png":
        import cv2

        cv2.imwrite(str(out), made.picture(200))
    else:
        _write_pdf(made, out)
    width, height = made.size
    typer.echo(f"{out}: pattern of {1e3 * width:.0f} x {1e3 * height:.0f} mm")


@calibrate.command()
def intrinsics(
    images: Images,
    out: Out,
    columns: Columns = 9,
    rows: Rows = 6,
    square: Square = 0.030,
    marker: Marker = 0.022,
    max_error: MaxError = 0.7,
    as_json: Json = False,
) -> None:
    """Lens and focal length from pictures of the board: near, far, tilted, in all corners.

    Exit code 0: written. 1: refused, with value, limit and remedy. 2: unusable input.
    """
    from codesign_perception.calibration import CalibrationError, calibrate_intrinsics
    from codesign_perception.camera_file import CameraFile, Record

    views, size = _views(images, _board(columns, rows, square, marker))
    try:
        found = calibrate_intrinsics([v for _, v in views], *size, max_error)
    except CalibrationError as error:
        _refuse(error)
    record = Record.now("charuco", found.error, found.views)
    CameraFile(found.camera, record).save(out)
    _print(
        {
            "camera_file": str(out),
            "pictures_used": found.views,
            "pictures_without_board": len(images) - len(views),
            "reprojection_error_px": found.error,
            "focal_px": found.camera.matrix[[0, 1], [0, 1]].tolist(),
            "center_px": found.camera.matrix[:2, 2].tolist(),
            "distortion": found.camera.distortion.tolist(),
        },
        as_json,
    )


@calibrate.command()
def extrinsics(
    images: Images,
    camera: CameraPath,
    out: Out,
    position: Annotated[
        tuple[float, float, float],
        typer.Option(help="Middle of the board, which lies flat, in link_base [m]."),
    ] = (0.45, 0.0, 0.0),
    yaw: Annotated[float, typer.Option(help="Turn of its x axis from that of link_base [deg].")] = (
        0.0
    ),
    columns: Columns = 9,
    rows: Rows = 6,
    square: Square = 0.030,
    marker: Marker = 0.022,
    max_error: MaxError = 0.7,
    as_json: Json = False,
) -> None:
    """Place of the camera from pictures of the board, lying at a known place on the table.

    Exit code 0: written. 1: refused, with value, limit and remedy. 2: unusable input.
    """
    import math

    from codesign_perception.calibration import (
        CalibrationError,
        calibrate_extrinsics,
        flat_pose,
    )

    lens = _load_file(camera)
    views, _ = _views(images, _board(columns, rows, square, marker), lens.camera)
    pose = flat_pose(position, math.radians(yaw))
    try:
        found = calibrate_extrinsics(
            [v for _, v in views], [pose] * len(views), lens.camera, max_error
        )
    except CalibrationError as error:
        _refuse(error)
    _save_place(found, lens, "charuco", out, as_json)


@calibrate.command("hand-eye")
def hand_eye(
    poses: Annotated[
        Path,
        typer.Option(
            help='JSON: {"poses": [{"image", and "q_rad" or "flange_position_m" with '
            '"flange_quaternion_xyzw"}]}; images relative to it.',
            exists=True,
            dir_okay=False,
        ),
    ],
    camera: CameraPath,
    out: Out,
    columns: Columns = 9,
    rows: Rows = 6,
    square: Square = 0.030,
    marker: Marker = 0.022,
    max_error: MaxError = 0.7,
    as_json: Json = False,
) -> None:
    """Place of the camera from pictures of the board fixed to the flange, in many postures.

    Exit code 0: written. 1: refused, with value, limit and remedy. 2: unusable input.
    """
    from codesign_perception.calibration import CalibrationError, calibrate_hand_eye

    lens = _load_file(camera)
    try:
        images, flange = _read_postures(poses)
    except (OSError, ValueError) as error:
        _fail(f"{poses}: {error}")
    views, _ = _views(images, _board(columns, rows, square, marker), lens.camera)
    try:
        found, mount = calibrate_hand_eye(
            [v for _, v in views], [flange[i] for i, _ in views], lens.camera, max_error
        )
    except CalibrationError as error:
        _refuse(error)
    extra = {"board_on_flange_m": mount[:3, 3].tolist()}
    _save_place(found, lens, "hand-eye", out, as_json, extra)


@app.command()
def estimate(
    image: Annotated[Path, typer.Argument(help="Picture.", exists=True, dir_okay=False)],
    camera: CameraPath,
    size: Annotated[
        tuple[float, float, float], typer.Option(help="Length, width, height of the block [m].")
    ] = (0.05, 0.03, 0.04),
    sag: Annotated[
        float, typer.Option(help="How far its top sinks under its weight [m].")
    ] = 0.0009,
    table_height: Annotated[float, typer.Option(help="z of the table in link_base [m].")] = 0.0,
    debug: Annotated[Path | None, typer.Option(help="Picture to write, with the outline.")] = None,
    as_json: Json = False,
) -> None:
    """Find the block in one picture.

    Exit code 0: found. 1: not found, and why. 2: unusable input.
    """
    import cv2

    from codesign_perception import EstimatorConfig, TofuPoseEstimator, load_camera
    from codesign_perception.debug_picture import debug_picture

    picture = _read_picture(image)
    try:
        config = EstimatorConfig(size=size, sag=sag, table_height=table_height)
        detection = TofuPoseEstimator(load_camera(camera), config).estimate(picture)
    except (OSError, ValueError) as error:
        _fail(str(error))
    if debug is not None:
        cv2.imwrite(str(debug), debug_picture(picture, detection, picture.shape[1]))
    pose = detection.pose
    result: dict[str, Any] = {"detected": pose is not None, "score": detection.score}
    if pose is None:
        result |= {"position_m": None, "yaw_rad": None, "reason": detection.reason}
    else:
        result |= {
            "position_m": pose.position.tolist(),
            "yaw_rad": pose.yaw,
            "standard_deviations": (pose.covariance.diagonal() ** 0.5).tolist(),
            "size_m": pose.size.tolist(),
            "rms_px": pose.rms,
            "state": pose.state,
        }
    _print(result, as_json)
    if pose is None:
        raise typer.Exit(1)


@app.command()
def bench(
    images: Annotated[int, typer.Option(min=1, help="Pictures with the block.")] = 300,
    empty: Annotated[int, typer.Option(min=1, help="Pictures with clutter only.")] = 60,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    camera: Annotated[
        Path | None, typer.Option(help="The true camera; by default that of the simulated graph.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Errors against the truth over rendered pictures: blur, noise, light +-20 %, clutter."""
    from codesign_cli.perception_bench import run_bench
    from codesign_perception import load_camera

    try:
        true = None if camera is None else load_camera(camera)
    except (OSError, ValueError) as error:
        _fail(str(error))
    result = run_bench(images, empty, seed, true, lambda text: typer.echo(text, err=True))
    _print(result, as_json)


# --- helpers


def _board(columns: int, rows: int, square: float, marker: float) -> CharucoBoard:
    from codesign_perception.board import CharucoBoard

    try:
        return CharucoBoard(columns, rows, square, marker)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error


def _read_picture(path: Path) -> NDArray[np.uint8]:
    """(height, width, 3) BGR."""
    import cv2
    import numpy as np

    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None:
        _fail(f"{path}: no picture that OpenCV can read")
    return np.asarray(picture, dtype=np.uint8)


def _views(
    images: list[Path], made: CharucoBoard, lens: Any = None
) -> tuple[list[tuple[int, View]], tuple[int, int]]:
    """(number, view) of every picture that shows the board, and the common width and height."""
    views, size = [], None if lens is None else (lens.width, lens.height)
    for i, path in enumerate(images):
        picture = _read_picture(path)
        here = (picture.shape[1], picture.shape[0])
        if size is not None and here != size:
            _fail(f"{path}: {here[0]} x {here[1]} px, expected {size[0]} x {size[1]}")
        size = here
        view = made.find(picture)
        if view is not None:
            views.append((i, view))
    assert size is not None
    return views, size


def _load_file(path: Path) -> Any:
    from codesign_perception import CameraFile

    try:
        return CameraFile.load(path)
    except (OSError, ValueError) as error:
        _fail(str(error))


def _save_place(
    found: Any,
    lens: Any,
    method: str,
    out: Path,
    as_json: bool,
    extra: dict[str, Any] | None = None,
) -> None:
    from codesign_perception.camera_file import CameraFile, Record

    record = Record.now(method, found.error, found.views)
    CameraFile(found.camera, lens.intrinsics, record).save(out)
    _print(
        {
            "camera_file": str(out),
            "pictures_used": found.views,
            "reprojection_error_px": found.error,
            "position_m": found.camera.position.tolist(),
            "quaternion_xyzw": found.camera.quaternion.tolist(),
            **(extra or {}),
        },
        as_json,
    )


def _read_postures(path: Path) -> tuple[list[Path], list[np.ndarray]]:
    """Pictures and (4, 4) flange poses; ValueError naming a bad entry."""
    content = json.loads(path.read_text(encoding="utf-8"))
    entries = content.get("poses") if isinstance(content, dict) else None
    if not isinstance(entries, list) or not entries:
        raise ValueError('expected an object with a non-empty list "poses"')
    images, flange = [], []
    for i, entry in enumerate(entries):
        try:
            images.append(path.parent / entry["image"])
            flange.append(_flange_pose(entry))
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"poses[{i}]: {error}") from error
    return images, flange


def _flange_pose(entry: dict[str, Any]) -> np.ndarray:
    import numpy as np

    from codesign_control import Xarm7
    from codesign_control.pose import Pose, finite_vector

    if "q_rad" in entry:
        return Xarm7().fk_flange(finite_vector("q_rad", entry["q_rad"], 7)).matrix
    pose = Pose(entry["flange_position_m"], entry["flange_quaternion_xyzw"])
    return np.asarray(pose.matrix)


def _write_pdf(made: CharucoBoard, out: Path) -> None:
    """True to scale: the page is the pattern and a margin."""
    from matplotlib.figure import Figure

    margin = 0.012
    width, height = made.size
    page = (width + 2 * margin, height + 2 * margin)
    figure = Figure(figsize=(page[0] / 0.0254, page[1] / 0.0254))
    axes = figure.add_axes((margin / page[0], margin / page[1], width / page[0], height / page[1]))
    axes.imshow(made.picture(100), cmap="gray", vmin=0, vmax=255, interpolation="none")
    axes.axis("off")
    axes.set_aspect("auto")
    figure.text(
        0.5, margin / page[1] / 3.0,
        f"{made.columns} x {made.rows} squares of {1e3 * made.square:g} mm, "
        f"markers {1e3 * made.marker:g} mm: print at 100 %",
        ha="center", size=7,
    )  # fmt: skip
    figure.savefig(out, dpi=300)


def _refuse(error: Exception) -> NoReturn:
    typer.echo(f"refused: {error}", err=True)
    raise typer.Exit(1) from error


def _fail(message: str) -> NoReturn:
    typer.echo(message, err=True)
    raise typer.Exit(2)


def _print(result: dict[str, Any], as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps(result))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table("quantity", "value")
    for name, value in result.items():
        table.add_row(name, _text(value))
    Console().print(table)


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return ", ".join(f"{v:.4g}" for v in value)
    return str(value)
