"""What a camera beside the cell sees: rendered, distorted, blurred and noisy, repeatable by seed.

The scene is drawn by `scene.SceneRenderer` through a pinhole with the camera's own focal lengths
and principal point; the lens's distortion is applied by resampling. A 3D point appears where
`Camera.project` says, to a tenth of a pixel.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.interpolate import RectBivariateSpline
from scipy.spatial.transform import Rotation

from codesign_perception.camera import Camera
from codesign_report.recording import Floats, SoftBody, TriangleMesh
from codesign_report.scene import Camera as Pinhole
from codesign_report.scene import Image, Look, Prop, SceneRenderer

TOFU = (0.97, 0.95, 0.90, 1.0)
CAMERA_LOOK = Look(
    tofu=TOFU,
    finger=(0.10, 0.20, 0.42, 1.0),
    body=(0.13, 0.14, 0.16, 1.0),
    table=(0.16, 0.42, 0.36, 1.0),
    grid=False,
    background=(0.33, 0.38, 0.46),
    shadow=0.45,
    sky=True,
)
"""Off-white tofu on a green mat, blue printed fingers, a dark gripper before a grey-blue wall."""

GRID = 16  # px, apart where the lens's distortion is computed
MOTION_STEPS = 64  # samples along a motion blur's line
NOISE_OFFSETS = 2**16  # places in the bank of noise where a picture may begin
SHOT_SHARE = 0.6  # of the noise at full scale that grows with the light

CLUTTER_SIZE = (0.008, 0.022)  # m, half lengths
CLUTTER_RING = (0.075, 0.20)  # m, from the object's place to a thing's centre
CLUTTER_VIEW = np.radians(40.0)  # on either side of the line to the camera nothing is put
CLUTTER_SHAPES = ("box", "cylinder", "sphere", "ellipsoid")


@dataclass(frozen=True)
class Effects:
    """What makes a picture worse than the ideal one. Everything random comes from `seed`.

    Attributes:
        noise: standard deviation at full scale [grey values of 255]; a part grows with the light.
        defocus: standard deviation of the blur [px].
        motion: length of a motion blur [px]; its direction is drawn for each picture.
        light: each picture's brightness is drawn from 1 - light to 1 + light.
        clutter: things on the table, not solid; every second one is as pale as tofu.
        rotation_error: angle between the camera that renders and the one that is given [rad].
        translation_error: distance between the two [m].
        seed: of all that is drawn.

    Raises:
        ValueError: a value that makes no sense.
    """

    noise: float = 0.0
    defocus: float = 0.0
    motion: float = 0.0
    light: float = 0.0
    clutter: int = 0
    rotation_error: float = 0.0
    translation_error: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        limits = {
            "noise": 100.0,
            "defocus": 20.0,
            "motion": 100.0,
            "light": 0.9,
            "clutter": 40,
            "rotation_error": 0.5,
            "translation_error": 0.5,
            "seed": 2**53,
        }
        for item in fields(self):
            value = getattr(self, item.name)
            if not 0 <= value <= limits[item.name]:
                raise ValueError(
                    f"effect {item.name} is {value}: must be from 0 to {limits[item.name]}"
                )


REALISTIC = Effects(noise=3.0, defocus=0.7, light=0.1)
"""As of a good machine-vision or depth camera's colour image indoors."""


@dataclass(frozen=True)
class SceneState:
    """What moves. None: it was not given to the camera either.

    Attributes:
        positions: of the soft body's nodes in link_base, (N, 3) [m].
        left_pose, right_pose: of the finger meshes in link_base, (7,): x y z [m], qx qy qz qw.
    """

    positions: npt.ArrayLike | None = None
    left_pose: npt.ArrayLike | None = None
    right_pose: npt.ArrayLike | None = None


@dataclass
class _Lens:
    """How a picture of the pinhole becomes one of the camera."""

    width: int
    height: int
    pinhole: Pinhole
    maps: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]] | None = field(default=None)


class RenderedCamera:
    """Takes pictures of a scene as a calibrated camera would. Use it from one thread.

    Args:
        camera: what is published about it: size, intrinsics, extrinsics.
        soft_body: topology and rest shape of the object; None: there is none.
        fingers: left and right mesh, or none.
        effects: how far the pictures are from ideal ones.
        props: other rigid things, such as the arm's links or a calibration board; move them
            between pictures.
        table_height: z of the table [m].
        focus: x, y where the object is about to be: clutter keeps away from there [m].
        look: colours and samples per pixel.

    Raises:
        RuntimeError: no offscreen OpenGL.
        ValueError: a lens whose distortion cannot be undone over the whole picture.
    """

    def __init__(
        self,
        camera: Camera,
        soft_body: SoftBody | None = None,
        fingers: Sequence[TriangleMesh] = (),
        *,
        effects: Effects | None = None,
        props: Sequence[Prop] = (),
        table_height: float = 0.0,
        focus: tuple[float, float] = (0.45, 0.0),
        look: Look = CAMERA_LOOK,
    ) -> None:
        self.effects = effects or Effects()
        self._camera = camera
        self._focus, self._table_height = focus, table_height
        self._lens = _lens(camera)
        self.true_camera = _displaced(camera, self.effects)
        self._clutter = [_hidden_thing() for _ in range(self.effects.clutter)]
        self._renderer = SceneRenderer(
            soft_body,
            fingers,
            self._lens.width,
            self._lens.height,
            table_height=table_height,
            center=focus,
            look=look,
            props=[*props, *self._clutter],
        )
        self.scatter_clutter(self.effects.seed)

    def __enter__(self) -> "RenderedCamera":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Free the OpenGL context."""
        self._renderer.close()

    @property
    def camera(self) -> Camera:
        """What is published. Set it to move the camera; its lens stays the same."""
        return self._camera

    @camera.setter
    def camera(self, camera: Camera) -> None:
        if not camera.same_lens(self._camera):
            raise ValueError("the new camera has another lens: make a new RenderedCamera")
        self._camera = camera
        self.true_camera = _displaced(camera, self.effects)

    def scatter_clutter(self, seed: int, focus: tuple[float, float] | None = None) -> None:
        """Lay out the clutter anew, around another place of the object if `focus` is given."""
        self._focus = focus or self._focus
        random = np.random.default_rng([seed, 0xC1])
        for i, thing in enumerate(self._clutter):
            _throw(thing, random, i, self._camera, self._focus, self._table_height)

    def capture(self, state: SceneState | None = None, frame: int = 0) -> Image:
        """One picture. The same state, seed and number of the frame give the same picture.

        Args:
            state: where things are.
            frame: number of the picture, at least 0: what its noise, light and motion are drawn by.

        Returns:
            (height, width, 3) RGB.
        """
        ideal = self.ideal(state)
        return spoil(ideal, self.effects, frame)

    def ideal(self, state: SceneState | None = None) -> Image:
        """As `capture`, without noise, blur and change of light."""
        state = state or SceneState()
        true = self.true_camera
        axes = true.rotation
        self._renderer.camera = replace(
            self._lens.pinhole, position=true.position, forward=axes[:, 2], up=-axes[:, 1]
        )
        picture = self._renderer.render(state.positions, None, state.left_pose, state.right_pose)
        if self._lens.maps is None:
            return picture
        remapped = cv2.remap(picture, *self._lens.maps, cv2.INTER_LINEAR)
        return np.asarray(remapped, dtype=np.uint8)


def spoil(picture: Image, effects: Effects, frame: int = 0) -> Image:
    """A picture with the light, blur and noise of `effects`; (H, W, 3) RGB."""
    e = effects
    random = np.random.default_rng([e.seed, frame])
    gain = 1.0 + random.uniform(-e.light, e.light)
    angle = random.uniform(0.0, np.pi)
    seen: Any = picture
    if e.light > 0.0:
        seen = cv2.convertScaleAbs(seen, alpha=gain)
    if e.motion > 0.0:
        seen = cv2.filter2D(seen, -1, _line(e.motion, angle), borderType=cv2.BORDER_REPLICATE)
    if e.defocus > 0.0:
        seen = cv2.GaussianBlur(seen, (0, 0), e.defocus, borderType=cv2.BORDER_REPLICATE)
    if e.noise > 0.0:
        seen = _noisy(seen, e, int(random.integers(NOISE_OFFSETS)))
    return np.asarray(seen, dtype=np.uint8)


def board_prop(
    picture: Image,
    size: tuple[float, float],
    position: npt.ArrayLike = (0.0, 0.0, 0.0),
    rotation: npt.ArrayLike | None = None,
) -> Prop:
    """A flat board, such as one for calibration.

    Args:
        picture: (rows, columns) or (rows, columns, 3), 0 to 255; its first row lies along +y, seen
            from +z with x to the right.
        size: of the whole picture along x and y [m].
        position: of its middle in link_base [m].
        rotation: (3, 3), its axes in link_base.
    """
    rgb = picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=2)
    return Prop(
        "panel",
        (size[0] / 2.0, size[1] / 2.0, 0.0005),
        position=np.asarray(position, dtype=np.float64),
        rotation=np.eye(3) if rotation is None else np.asarray(rotation, dtype=np.float64),
        picture=np.ascontiguousarray(rgb, dtype=np.uint8),
    )


# -- the lens ------------------------------------------------------------------------------------


def _lens(camera: Camera) -> _Lens:
    """The pinhole that sees all that the lens does, and where each of its pixels comes from."""
    focal, center = camera.matrix[[0, 1], [0, 1]], camera.matrix[:2, 2]
    if not camera.distortion.any():
        width, height = camera.width, camera.height
        return _Lens(width, height, _pinhole(focal, center, width, height))
    straight = _straight(camera)
    low = np.floor(straight.min(axis=0)) - 1.0
    high = np.ceil(straight.max(axis=0)) + 1.0
    width, height = (int(n) for n in high - low + 1.0)
    if max(width, height) > 4 * max(camera.width, camera.height):
        raise ValueError(
            f"distortion {camera.distortion.tolist()}: the picture would need {width} x {height} px"
            " without it: give a weaker lens"
        )
    maps = (straight - low).astype(np.float32).reshape(camera.height, camera.width, 2)
    pinhole = _pinhole(focal, center - low, width, height)
    return _Lens(width, height, pinhole, (maps[..., 0].copy(), maps[..., 1].copy()))


def _straight(camera: Camera) -> Floats:
    """Where each pixel would be without distortion, (height * width, 2) [px].

    Computed on a grid, for it takes long and is smooth; between its points by cubic splines.
    """
    across, down = (
        np.linspace(0.0, n - 1.0, -(-n // GRID) + 1) for n in (camera.width, camera.height)
    )
    u, v = np.meshgrid(across, down)
    flat = _undistorted(camera, np.column_stack([u.ravel(), v.ravel()]))
    places = flat * camera.matrix[[0, 1], [0, 1]] + camera.matrix[:2, 2]
    columns, rows = np.arange(camera.width), np.arange(camera.height)
    return np.stack(
        [
            RectBivariateSpline(down, across, axis.reshape(u.shape))(rows, columns)
            for axis in places.T
        ],
        axis=-1,
    ).reshape(-1, 2)


def _undistorted(camera: Camera, pixels: Floats) -> Floats:
    """(N, 2) x / z, y / z in the camera's frame, checked by distorting them again."""
    flat = camera.normalized(pixels)
    local = np.column_stack([flat, np.ones(len(flat))])
    again = camera.project(local @ camera.rotation.T + camera.position)
    error = float(np.abs(again - pixels).max())
    if not error < 0.02:
        raise ValueError(
            f"distortion {camera.distortion.tolist()} cannot be undone over the whole picture "
            f"(off by {error:.2g} px): give a weaker lens"
        )
    return flat


def _pinhole(focal: Floats, center: Floats, width: int, height: int) -> Pinhole:
    """The scene's camera of a camera matrix, for OpenCV's pixels: whole numbers are centres."""
    return Pinhole(
        position=np.zeros(3),
        forward=np.array([1.0, 0.0, 0.0]),
        fovy=2.0 * float(np.arctan(height / 2.0 / focal[1])),
        shift=(
            float((center[0] + 0.5 - width / 2.0) / height),
            float((height / 2.0 - center[1] - 0.5) / height),
        ),
        pixel_aspect=float(focal[1] / focal[0]),
    )


def _displaced(camera: Camera, effects: Effects) -> Camera:
    """Where the camera really is: off by exactly the errors, in directions drawn by the seed."""
    if not (effects.rotation_error or effects.translation_error):
        return camera
    random = np.random.default_rng([effects.seed, 0xCA])
    axis, direction = (d / np.linalg.norm(d) for d in random.standard_normal((2, 3)))
    turn = Rotation.from_rotvec(effects.rotation_error * axis)
    return camera.moved(
        camera.position + effects.translation_error * direction,
        (turn * Rotation.from_quat(camera.quaternion)).as_quat(),
    )


# -- the picture ---------------------------------------------------------------------------------


def _line(length: float, angle: float) -> npt.NDArray[np.float32]:
    """Kernel of a motion blur: a line through the middle, of this length [px]."""
    half = int(np.ceil(length / 2.0)) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1))
    for s in np.linspace(-length / 2.0, length / 2.0, MOTION_STEPS):
        x, y = half + s * np.cos(angle), half + s * np.sin(angle)
        i, j = int(np.floor(y)), int(np.floor(x))
        b, a = y - i, x - j
        kernel[i : i + 2, j : j + 2] += np.outer([1.0 - b, b], [1.0 - a, a])
    return (kernel / kernel.sum()).astype(np.float32)


def _noisy(picture: Image, effects: Effects, offset: int) -> Image:
    """Noise whose variance grows with the light: `noise` at 255, less in the dark."""
    level = np.arange(256) / 255.0
    spread = effects.noise * np.sqrt(1.0 - SHOT_SHARE + SHOT_SHARE * level)
    drawn = _noise_bank(picture.size, effects.seed)[offset : offset + picture.size]
    noise = cv2.multiply(cv2.LUT(picture, spread.astype(np.float32)), drawn.reshape(picture.shape))
    return np.asarray(cv2.add(picture, noise, dtype=cv2.CV_8U), dtype=np.uint8)


@lru_cache(maxsize=2)
def _noise_bank(count: int, seed: int) -> npt.NDArray[np.float32]:
    """Normal numbers for one picture from any offset: to draw them anew takes longer than all
    else that spoils a picture."""
    random = np.random.default_rng([seed, 0x4E])
    return random.standard_normal(count + NOISE_OFFSETS, dtype=np.float32)


# -- clutter -------------------------------------------------------------------------------------


def _hidden_thing() -> Prop:
    return Prop("box", (0.01, 0.01, 0.01), visible=False)


def _throw(
    thing: Prop,
    random: np.random.Generator,
    index: int,
    camera: Camera,
    focus: tuple[float, float],
    table_height: float,
) -> None:
    """Gives a thing a size, a colour and a place on the table, not between camera and object."""
    half = random.uniform(*CLUTTER_SIZE, 3)
    thing.shape = CLUTTER_SHAPES[random.integers(len(CLUTTER_SHAPES))]
    sizes = {"sphere": half[2:], "cylinder": half[1:]}.get(thing.shape, half)
    thing.size = tuple(float(s) for s in sizes)
    if index % 2:
        shade = random.uniform(0.8, 1.0)
        pale = np.array(TOFU[:3]) * shade * random.uniform(0.96, 1.04, 3)
        color = np.clip(pale, 0.0, 1.0)
    else:
        color = random.uniform(0.05, 0.95, 3)
    thing.color = (float(color[0]), float(color[1]), float(color[2]), 1.0)
    toward = np.arctan2(camera.position[1] - focus[1], camera.position[0] - focus[0])
    angle = toward + random.uniform(CLUTTER_VIEW, 2.0 * np.pi - CLUTTER_VIEW)
    distance = random.uniform(*CLUTTER_RING)
    thing.position = np.array(
        [
            focus[0] + distance * np.cos(angle),
            focus[1] + distance * np.sin(angle),
            table_height + half[2],
        ]
    )
    thing.rotation = Rotation.from_euler("z", random.uniform(-np.pi, np.pi)).as_matrix()
    thing.visible = True
