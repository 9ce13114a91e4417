"""Pictures of the grasp: tofu coloured by von Mises stress or plain, fingers, a table; offscreen.

MuJoCo serves as a plain mesh renderer: no physics is stepped. Every mesh is uploaded as separate
triangles, so that this module alone decides on normals and colours. Stress is a texture
coordinate into a colour map, not a vertex colour: colours between nodes stay on the map.
"""

import ctypes.util
import importlib
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix

from codesign_report.recording import Floats, Ints, SoftBody, TriangleMesh

Image = npt.NDArray[np.uint8]

COLOR_MAP = "magma_r"
"""Of matplotlib; perceptually uniform, and tofu at rest looks like tofu."""

COLOR_MAP_END = 0.92
"""The map is cut before it turns black, where nothing can be told apart."""

NO_RENDERER = (
    "no offscreen OpenGL: apt-get install libegl1 libgl1-mesa-dri (or libosmesa6), "
    "or set MUJOCO_GL to egl or osmesa"
)

CREASE_ANGLE = np.radians(40.0)
"""Neighbouring faces that meet at a sharper angle at rest keep an edge."""

# A lit surface shows albedo * (emission + light). The soft body's two parts add up to 1 where it
# faces the lights: there its colour is exactly the map's; elsewhere it is a shade darker.
SOFT_ALBEDO = 0.25
SOFT_EMISSION = 0.82 / SOFT_ALBEDO

FINGER_COLOR = (0.40, 0.55, 0.72, 0.45)
BODY_COLOR = (0.80, 0.83, 0.86, 1.0)
SHADOW_ALPHA = 0.32
SHADOW_SPREAD = 1.5
"""Size of a soft shadow's picture relative to the solid above it; the rest is penumbra."""
SHADOW_FADE = 0.06
"""A soft shadow halves when its object rises by this much [m]."""

BACKGROUND = (0.955, 0.962, 0.970)

GEOM_DEFAULT = (0.5, 0.5, 0.5, 1.0)
"""Of MuJoCo: a geom of this colour has the colour of its material."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: position [m], viewing and up direction in link_base, vertical view [rad].

    Attributes:
        shift: where the optical axis meets the picture, as a share of its height, right and up
            of the centre.
        pixel_aspect: width over height of what a pixel sees, fy / fx of a camera matrix.
    """

    position: Floats
    forward: Floats
    up: Floats = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    fovy: float = np.radians(24.0)
    shift: tuple[float, float] = (0.0, 0.0)
    pixel_aspect: float = 1.0

    @staticmethod
    def look_at(position: npt.ArrayLike, target: npt.ArrayLike, **kwargs: Any) -> "Camera":
        """From a position towards a target, upright."""
        position = np.asarray(position, dtype=np.float64)
        return Camera(position, np.asarray(target, dtype=np.float64) - position, **kwargs)


Rgba = tuple[float, float, float, float]


@dataclass(frozen=True)
class Look:
    """Colours and quality of a scene; RGB and RGBA from 0 to 1.

    Attributes:
        tofu: of the soft body where no stress is drawn.
        finger, body: of the fingers, and of the boxes that hint at the gripper.
        table: tints the table's picture.
        grid: lines on the table every 10 mm, for people; without, it is plain.
        background: what the table fades into.
        sky: the background's colour also above the horizon, which else is black.
        shadow: how dark the soft shadows are, 0 to 1.
        samples: per pixel, 0 (jagged edges), 2, 4 or 8.
    """

    tofu: Rgba = (0.97, 0.94, 0.86, 1.0)
    finger: Rgba = FINGER_COLOR
    body: Rgba = BODY_COLOR
    table: Rgba = (1.0, 1.0, 1.0, 1.0)
    grid: bool = True
    background: tuple[float, float, float] = BACKGROUND
    sky: bool = False
    shadow: float = SHADOW_ALPHA
    samples: int = 4


@dataclass
class Prop:
    """Something rigid beside the grasp, drawn where `position` and `rotation` are at the time.

    Attributes:
        shape: "box", "cylinder", "sphere", "ellipsoid", "capsule" or "panel".
        size: half lengths (3) of a box, an ellipsoid and a panel (its third is not used); radius
            and half length along z of a cylinder and a capsule; radius of a sphere [m].
        color: RGBA, 0 to 1.
        position: of its centre in link_base, (3,) [m].
        rotation: its axes in link_base, (3, 3).
        picture: of a panel only: what is on it, (rows, columns, 3); its first row lies along +y,
            seen from +z with x to the right.
        visible: whether it is drawn.
    """

    shape: str
    size: tuple[float, ...]
    color: Rgba = (0.7, 0.7, 0.7, 1.0)
    position: Floats = field(default_factory=lambda: np.zeros(3))
    rotation: Floats = field(default_factory=lambda: np.eye(3))
    picture: Image | None = None
    visible: bool = True


class SceneRenderer:
    """Draws the soft body, the fingers, a hint of the gripper, the table and other things.

    One renderer owns one OpenGL context: use it from the thread that made it, close it when done
    (or use `with`). Poses are (7,) x y z [m] qx qy qz qw of the finger meshes' frame in link_base.

    Args:
        soft_body: topology and rest shape; None: there is none.
        fingers: left and right mesh, or none at all.
        width, height: of the picture [px].
        stress_range: von Mises stress at both ends of the colour map [Pa].
        table_height: z of the table top [m].
        center: x, y of the scene's middle, where lights aim [m].
        look: colours and quality.
        props: what else is there. Move, reshape (not panels), recolour and hide them between
            pictures.

    Raises:
        RuntimeError: no offscreen OpenGL; the message names the packages.
        ValueError: sizes or range make no sense.
    """

    def __init__(
        self,
        soft_body: SoftBody | None,
        fingers: Sequence[TriangleMesh],
        width: int = 1280,
        height: int = 720,
        *,
        stress_range: tuple[float, float] = (0.0, 8000.0),
        table_height: float = 0.0,
        center: tuple[float, float] = (0.0, 0.0),
        look: Look | None = None,
        props: Sequence[Prop] = (),
    ) -> None:
        if not (16 <= width <= 7680 and 16 <= height <= 4320):
            raise ValueError(f"picture is {width} x {height} px: give 16 x 16 to 7680 x 4320")
        low, high = stress_range
        if not -np.inf < low < high < np.inf:
            raise ValueError(f"stress_range is {stress_range} Pa: give two increasing numbers")
        if len(fingers) not in (0, 2):
            raise ValueError(f"fingers holds {len(fingers)} meshes: give left and right, or none")
        self.width, self.height = width, height
        self.table_height = table_height
        self.stress_range = (float(low), float(high))
        self.camera = Camera.look_at(
            [center[0] + 0.55, center[1] - 0.3, table_height + 0.25],
            [center[0], center[1], table_height + 0.03],
        )
        self._look = look or Look()
        self.props = list(props)
        for prop in self.props:
            _check_prop(prop)
        self._soft = _SoftSurface(soft_body) if soft_body else None
        self._fingers = [_Soup(mesh) for mesh in fingers]
        self._links = _gripper_links(fingers) if fingers else []
        # Numbers of the scene's parts, in the order of `_add_geoms`.
        self._first_finger = 1 if soft_body else 0
        self._first_link = self._first_finger + len(fingers)
        self._first_shadow = self._first_link + len(self._links)
        self._first_prop = self._first_shadow + self._first_link
        self._gl: Any = _gl_context_class()(width, height)
        self._gl.make_current()
        self._build(table_height, center)

    def __enter__(self) -> "SceneRenderer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Free the OpenGL context. Nothing can be drawn afterwards."""
        if self._gl is not None:
            self._gl.make_current()
            self._context.free()
            self._gl.free()
            self._gl = None

    def render(
        self,
        positions: npt.ArrayLike | None = None,
        von_mises: npt.ArrayLike | None = None,
        left_pose: npt.ArrayLike | None = None,
        right_pose: npt.ArrayLike | None = None,
    ) -> Image:
        """One picture.

        Args:
            positions: of the soft body's nodes in link_base, (N, 3) [m].
            von_mises: per tetrahedron, (E,) [Pa]; None: plain tofu, as a camera sees it.
            left_pose, right_pose: (7,) of the finger meshes.

        Returns:
            (height, width, 3) RGB.
        """
        import mujoco

        if self._gl is None:
            raise RuntimeError("the renderer is closed: make a new one")
        self._gl.make_current()
        solids: list[tuple[Floats, float]] = []
        if self._soft:
            nodes = np.asarray(positions, dtype=np.float64)
            self._upload_soft_body(self._soft, nodes, von_mises)
            solids.append((nodes, _yaw(self._soft.rest, nodes)))
        if self._fingers:
            poses = [np.asarray(pose, dtype=np.float64) for pose in (left_pose, right_pose)]
            self._place(*poses)
            solids += [
                _placed(finger, pose) for finger, pose in zip(self._fingers, poses, strict=True)
            ]
        self._cast_shadows(solids)
        self._place_props()
        mujoco.mjv_updateScene(
            self._model, self._data, self._option, None, mujoco.MjvCamera(),
            mujoco.mjtCatBit.mjCAT_ALL.value, self._scene,
        )  # fmt: skip
        self._aim()
        view = mujoco.MjrRect(0, 0, self.width, self.height)
        mujoco.mjr_render(view, self._scene, self._context)
        pixels = np.empty((self.height, self.width, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(pixels, None, view, self._context)
        return np.ascontiguousarray(pixels[::-1])

    # -- one frame -------------------------------------------------------------------------------

    def _upload_soft_body(
        self, soft: "_SoftSurface", positions: Floats, von_mises: npt.ArrayLike | None
    ) -> None:
        import mujoco

        vertices, normals = soft.shape(positions)
        values = np.zeros(len(vertices))
        if von_mises is not None:
            low, high = self.stress_range
            stress = soft.values(np.asarray(von_mises, dtype=np.float64))
            values = np.clip((stress - low) / (high - low), 0.0, 1.0)
        model = self._model
        first = model.mesh_vertadr[0]
        model.mesh_vert[first : first + len(vertices)] = vertices
        model.mesh_normal[first : first + len(vertices)] = normals
        model.mesh_texcoord[: len(vertices), 0] = _texture_coordinate(values)
        model.geom_matid[0] = 0 if von_mises is not None else 1
        mujoco.mjr_uploadMesh(model, self._context, 0)

    def _place(self, left: Floats, right: Floats) -> None:
        rotations = [_rotation(left), _rotation(right)]
        for i, (pose, rotation) in enumerate(zip((left, right), rotations, strict=True)):
            self._set_geom(self._first_finger + i, pose[:3], rotation)
        palm = (left[:3] + right[:3]) / 2.0
        for i, link in enumerate(self._links):
            origin = palm if link.finger is None else (left, right)[link.finger][:3]
            rotation = rotations[link.finger or 0]
            self._set_geom(self._first_link + i, origin + rotation @ link.center, rotation)

    def _place_props(self) -> None:
        for i, prop in enumerate(self.props):
            geom = self._first_prop + i
            self._set_geom(geom, prop.position, prop.rotation)
            color = prop.color if prop.picture is None else GEOM_DEFAULT
            self._model.geom_rgba[geom] = color if prop.visible else (0.0, 0.0, 0.0, 0.0)
            if prop.picture is None:
                _check_prop(prop)
                self._model.geom_type[geom] = _geom_type(prop.shape)
                self._model.geom_size[geom, : len(prop.size)] = prop.size

    def _cast_shadows(self, solids: Sequence[tuple[Floats, float]]) -> None:
        """A soft blot under each solid (points, yaw): true shadows take twice the time."""
        first = self._first_shadow
        for i, (points, yaw) in enumerate(solids):
            turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
            local = points[:, :2] @ turn
            low, high = local.min(axis=0), local.max(axis=0)
            rise = max(points[:, 2].min() - self.table_height, 0.0)
            rotation = np.eye(3)
            rotation[:2, :2] = turn
            # Each blot lies a little higher than the last, so that they do not fight for depth.
            height = self.table_height + 2e-4 * (i + 1)
            self._set_geom(first + i, np.array([*turn @ (low + high) / 2.0, height]), rotation)
            self._model.geom_size[first + i, :2] = SHADOW_SPREAD * (high - low) / 2.0 + 0.2 * rise
            darkness = self._look.shadow * 0.5 ** (rise / SHADOW_FADE)
            self._model.mat_rgba[self._model.geom_matid[first + i], 3] = darkness

    def _set_geom(self, index: int, position: Floats, rotation: Floats) -> None:
        self._data.geom_xpos[index] = position
        self._data.geom_xmat[index] = rotation.ravel()

    def _aim(self) -> None:
        camera = self.camera
        forward = camera.forward / np.linalg.norm(camera.forward)
        right = np.cross(forward, camera.up)
        right /= np.linalg.norm(right)
        near, far = 0.02, 8.0
        half = near * float(np.tan(camera.fovy / 2.0))
        for eye in self._scene.camera:
            eye.pos = camera.position
            eye.forward = forward
            eye.up = np.cross(right, forward)
            eye.frustum_near, eye.frustum_far = near, far
            eye.frustum_top = half * (1.0 - 2.0 * camera.shift[1])
            eye.frustum_bottom = -half * (1.0 + 2.0 * camera.shift[1])
            eye.frustum_width = half * camera.pixel_aspect * self.width / self.height
            eye.frustum_center = -half * camera.pixel_aspect * 2.0 * camera.shift[0]
            eye.orthographic = 0
        # The lamp rides with the camera, behind its left shoulder: what it sees is always lit.
        level = np.array([forward[0], forward[1], 0.0])
        level /= max(float(np.linalg.norm(level)), 1e-9)
        beam = 0.5 * level + 0.35 * right - [0.0, 0.0, 0.8]
        for light in list(self._scene.lights)[: self._scene.nlight]:
            if not light.headlight:
                light.dir = beam / np.linalg.norm(beam)

    # -- the scene -------------------------------------------------------------------------------

    def _build(self, table_height: float, center: tuple[float, float]) -> None:
        import mujoco

        spec = mujoco.MjSpec()
        spec.visual.global_.offwidth, spec.visual.global_.offheight = self.width, self.height
        spec.visual.quality.offsamples = self._look.samples
        spec.visual.headlight.ambient = [0.56] * 3
        spec.visual.headlight.diffuse = [0.24] * 3
        spec.visual.headlight.specular = [0.0] * 3
        spec.visual.rgba.haze = [*self._look.background, 1.0]
        spec.stat.extent = 1.0
        spec.stat.center = [*center, table_height]
        _add_materials(spec, self._look)
        self._add_geoms(spec, table_height, center)
        spec.worldbody.add_light(
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            diffuse=[0.34] * 3,
            specular=[0.25] * 3,
            castshadow=False,
        )
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, self._data)
        self._undo_recentring()
        if self._soft:
            self._set_geom(0, np.zeros(3), np.eye(3))
        self._scene = mujoco.MjvScene(self._model, maxgeom=64 + len(self.props))
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        self._scene.flags[mujoco.mjtRndFlag.mjRND_HAZE] = True
        self._option = mujoco.MjvOption()
        self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)

    def _add_geoms(self, spec: Any, table_height: float, center: tuple[float, float]) -> None:
        import mujoco

        soups = self._soups()
        for name, soup in soups.items():
            _add_mesh(spec, name, soup)
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=name,
                material="stress" if name == "soft" else "finger",
                contype=0,
                conaffinity=0,
            )
        for link in self._links:
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX, size=link.half_size, material="body"
            )
        for i in range(len(soups)):
            _add_shadow(spec, i)
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.05, 0.05, 0.01], material=f"shadow{i}"
            )
        for i, prop in enumerate(self.props):
            _add_prop(spec, f"prop{i}", prop)
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[0, 0, 0.01],
            pos=[*center, table_height],
            material="table",
        )

    def _soups(self) -> dict[str, "_Soup"]:
        """The scene's meshes by name, in the model's order."""
        soft = {"soft": self._soft.soup} if self._soft else {}
        return soft | dict(zip(("left", "right"), self._fingers, strict=False))

    def _undo_recentring(self) -> None:
        """The compiler moves meshes to their principal axes; put back the given frames."""
        panels = [_panel_corners(prop) for prop in self.props if prop.picture is not None]
        soups = [(soup.corners, soup.normals) for soup in self._soups().values()]
        pairs = [*soups, *((corners, np.tile([0.0, 0.0, 1.0], (6, 1))) for corners in panels)]
        for first, (corners, normals) in zip(self._model.mesh_vertadr, pairs, strict=True):
            span = slice(first, first + len(corners))
            self._model.mesh_vert[span] = corners
            self._model.mesh_normal[span] = normals


@dataclass(frozen=True)
class _Link:
    """A box that hints at the gripper; finger None: it sits between both."""

    finger: int | None
    center: Floats
    half_size: tuple[float, float, float]


class _Soup:
    """A mesh as separate triangles, with normals smoothed except across creases."""

    def __init__(self, mesh: TriangleMesh) -> None:
        self.triangles = mesh.triangles
        self._blend = _corner_blend(mesh.vertices, mesh.triangles)
        self.corners, self.normals = self.shape(mesh.vertices)

    def shape(self, vertices: Floats) -> tuple[Floats, Floats]:
        """Corners and their normals for moved vertices, (3 F, 3) each."""
        corners = vertices[self.triangles]
        faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals = self._blend @ faces
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return corners.reshape(-1, 3), normals / np.maximum(length, 1e-30)


class _SoftSurface:
    """Surface of the soft body: shape and per-corner stress."""

    def __init__(self, body: SoftBody) -> None:
        self.rest = body.rest_positions
        self.soup = _Soup(TriangleMesh(body.rest_positions, body.surface_triangles))
        corner_nodes = body.surface_triangles.ravel()
        tets = np.repeat(body.surface_tetrahedra, 3)
        shape = (len(body.rest_positions), len(body.tetrahedra))
        to_nodes = csr_matrix((np.ones(len(tets)), (corner_nodes, tets)), shape=shape)
        count = np.maximum(np.asarray(to_nodes.sum(axis=1)).ravel(), 1.0)
        to_nodes = csr_matrix(to_nodes.multiply(1.0 / count[:, None]))
        self._to_corners = to_nodes[corner_nodes]
        self.shape = self.soup.shape

    def values(self, per_tetrahedron: Floats) -> Floats:
        """Per corner: mean over the tetrahedra behind the faces around its node."""
        return self._to_corners @ per_tetrahedron


def _corner_blend(vertices: Floats, triangles: Ints) -> csr_matrix:
    """(3 F, F): sums the area-weighted face normals around a corner that lie within the crease."""
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    # Vertices at one place count as one: STL meshes repeat them.
    _, node = np.unique(np.round(vertices, 7), axis=0, return_inverse=True)
    corner_node = node.ravel()[triangles].ravel()
    faces = np.repeat(np.arange(len(triangles)), 3)
    incidence = csr_matrix((np.ones(len(faces)), (corner_node, faces)))
    pairs = incidence[corner_node].tocoo()
    smooth = np.einsum("ij,ij->i", normals[faces[pairs.row]], normals[pairs.col])
    keep = smooth > np.cos(CREASE_ANGLE)
    shape = (len(faces), len(triangles))
    return csr_matrix((np.ones(keep.sum()), (pairs.row[keep], pairs.col[keep])), shape=shape)


def _gripper_links(fingers: Sequence[TriangleMesh]) -> list[_Link]:
    """A carriage behind each finger's mount and a palm above both, sized by the meshes."""
    low = np.min([mesh.vertices.min(axis=0) for mesh in fingers], axis=0)
    high = np.max([mesh.vertices.max(axis=0) for mesh in fingers], axis=0)
    root, reach = low[2], max(abs(low[1]), abs(high[1]))
    half = (0.010, 0.005, 0.026)
    links = [
        _Link(i, np.array([0.0, side * (reach + half[1]), root - 0.012]), half)
        for i, side in enumerate((1.0, -1.0))
    ]
    return [*links, _Link(None, np.array([0.0, 0.0, root - 0.046]), (0.02, 0.06, 0.014))]


def _add_mesh(spec: Any, name: str, soup: _Soup) -> None:
    import mujoco

    order = np.arange(len(soup.corners)).tolist()
    spec.add_mesh(
        name=name,
        uservert=soup.corners.ravel().tolist(),
        usernormal=soup.normals.ravel().tolist(),
        usertexcoord=np.zeros(2 * len(order)).tolist(),
        userface=order,
        userfacenormal=order,
        userfacetexcoord=order,
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )


def _add_materials(spec: Any, look: Look) -> None:
    import mujoco

    _add_texture(spec, "stress", _stress_texture())
    _add_texture(spec, "grid", _grid_texture() if look.grid else _plain_texture())
    _add_texture(spec, "shadow", _shadow_texture())
    rgb = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
    soft = {"rgba": [SOFT_ALBEDO] * 3 + [1.0], "emission": SOFT_EMISSION, "specular": 0.0}
    stress = spec.add_material(name="stress", **soft)
    stress.textures[rgb] = "stress"
    spec.add_material(name="tofu", rgba=look.tofu, specular=0.1)
    spec.add_material(name="finger", rgba=look.finger, specular=0.5, shininess=0.4)
    spec.add_material(name="body", rgba=look.body, specular=0.2)
    table = spec.add_material(
        name="table", rgba=look.table, specular=0.0, texuniform=True, texrepeat=[20.0, 20.0]
    )
    table.textures[rgb] = "grid"
    if look.sky:
        spec.add_texture(
            name="sky",
            type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
            builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
            rgb1=look.background,
            rgb2=look.background,
            width=16,
            height=16,
        )


def _add_shadow(spec: Any, index: int) -> None:
    import mujoco

    shadow = spec.add_material(
        name=f"shadow{index}", rgba=[0.10, 0.13, 0.17, 0.5], specular=0.0, emission=1.0
    )
    shadow.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = "shadow"


PROP_SIZES = {"box": 3, "cylinder": 2, "sphere": 1, "ellipsoid": 3, "capsule": 2, "panel": 3}


def _check_prop(prop: Prop) -> None:
    count = PROP_SIZES.get(prop.shape)
    if count is None:
        raise ValueError(f"prop of shape {prop.shape!r}: give one of {', '.join(PROP_SIZES)}")
    if len(prop.size) != count or not all(0.0 < s < np.inf for s in prop.size):
        raise ValueError(f"{prop.shape} of size {prop.size}: give {count} positive lengths [m]")
    if (prop.picture is not None) != (prop.shape == "panel"):
        raise ValueError(f"{prop.shape} with picture {prop.picture is not None}: a panel has one")


def _geom_type(shape: str) -> Any:
    import mujoco

    return getattr(mujoco.mjtGeom, f"mjGEOM_{shape.upper()}")


def _add_prop(spec: Any, name: str, prop: Prop) -> None:
    import mujoco

    if prop.picture is None:
        kind = _geom_type(prop.shape)
        spec.worldbody.add_geom(type=kind, size=[*prop.size, 0.0, 0.0][:3], rgba=prop.color)
        return
    _add_texture(spec, name, np.ascontiguousarray(prop.picture[::-1]))
    # Lit from anywhere it shows its picture a little darker, as paper does.
    material = spec.add_material(name=name, rgba=[1.0] * 4, specular=0.0)
    material.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = name
    corners = _panel_corners(prop)
    order = np.arange(6).tolist()
    spec.add_mesh(
        name=name,
        uservert=corners.ravel().tolist(),
        usernormal=[0.0, 0.0, 1.0] * 6,
        usertexcoord=(corners[:, :2] / (2.0 * np.array(prop.size[:2])) + 0.5).ravel().tolist(),
        userface=order,
        userfacenormal=order,
        userfacetexcoord=order,
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=name, contype=0, conaffinity=0
    )


def _panel_corners(prop: Prop) -> Floats:
    """Of two triangles that face +z, (6, 3) [m]."""
    x, y = prop.size[:2]
    a, b, c, d = ([-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0])
    return np.array([a, b, c, a, c, d])


def _add_texture(spec: Any, name: str, pixels: Image) -> None:
    import mujoco

    texture = spec.add_texture(
        name=name,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        height=pixels.shape[0],
        width=pixels.shape[1],
        nchannel=pixels.shape[2],
    )
    texture.data = pixels.tobytes()


@cache
def color_table() -> Floats:
    """The colour map, (256, 3) RGB in 0..1."""
    import matplotlib

    table: Floats = matplotlib.colormaps[COLOR_MAP](np.linspace(0.0, COLOR_MAP_END, 256))[:, :3]
    return table


def stress_color(value: float, stress_range: tuple[float, float]) -> tuple[int, int, int]:
    """The RGB colour (0..255) of a stress [Pa]."""
    low, high = stress_range
    share = np.clip((value - low) / (high - low), 0.0, 1.0)
    r, g, b = np.round(255.0 * color_table()[round(255 * share)]).astype(int)
    return int(r), int(g), int(b)


def _stress_texture() -> Image:
    """The map in the middle half, its ends held outside: filtering must not wrap around."""
    table = np.round(255.0 * color_table()).astype(np.uint8)
    row = np.concatenate([np.repeat(table[:1], 128, 0), table, np.repeat(table[-1:], 128, 0)])
    return np.repeat(row[None], 4, axis=0)


def _texture_coordinate(share: Floats) -> Floats:
    """Where a share (0..1) of the stress range lies in the texture."""
    return (128.5 + 255.0 * share) / 512.0


def _grid_texture() -> Image:
    """A 50 mm cell of the table with faint lines every 10 mm."""
    size, cells = 500, 5
    pixels = np.full((size, size, 3), (236, 239, 242), dtype=np.uint8)
    for i in range(cells + 1):
        strong = i in (0, cells)
        color = (204, 211, 218) if strong else (224, 228, 233)
        width = 4 if strong else 2
        middle = i * size // cells
        line = slice(max(middle - width, 0), middle + width)
        pixels[line] = np.minimum(pixels[line], color)
        pixels[:, line] = np.minimum(pixels[:, line], color)
    return pixels


def _plain_texture() -> Image:
    return np.full((4, 4, 3), 255, dtype=np.uint8)


def _shadow_texture() -> Image:
    """A blurred rectangle as an alpha channel; white, to be tinted by its material."""
    ramp = np.linspace(-1.0, 1.0, 128)
    edge = np.clip((1.0 - np.abs(ramp)) / (1.0 - 1.0 / SHADOW_SPREAD) / 2.0, 0.0, 1.0)
    profile = edge * edge * (3.0 - 2.0 * edge)
    pixels = np.full((128, 128, 4), 255, dtype=np.uint8)
    pixels[..., 3] = np.round(255.0 * np.outer(profile, profile))
    return pixels


def _placed(finger: _Soup, pose: Floats) -> tuple[Floats, float]:
    """A finger's corners in link_base and the turn of its frame about z [rad]."""
    rotation = _rotation(pose)
    return finger.corners @ rotation.T + pose[:3], float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def _yaw(rest: Floats, current: Floats) -> float:
    """The turn about z that best carries one point set onto another [rad]."""
    a, b = (points[:, :2] - points[:, :2].mean(axis=0) for points in (rest, current))
    return float(np.arctan2((a[:, 0] @ b[:, 1] - a[:, 1] @ b[:, 0]), (a * b).sum()))


def _rotation(pose: Floats) -> Floats:
    """(3, 3) of a pose's quaternion x y z w."""
    x, y, z, w = pose[3:] / np.linalg.norm(pose[3:])
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


@cache
def _gl_context_class() -> Any:
    """MuJoCo's offscreen context: MUJOCO_GL if set, else EGL, else OSMesa."""
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    for name in (wanted,) if wanted in ("egl", "osmesa") else ("egl", "osmesa"):
        if ctypes.util.find_library("EGL" if name == "egl" else "OSMesa") is None:
            continue
        try:
            return _load_gl(name)
        except Exception:  # whatever a driver raises, the next one may work
            _unload_gl()
    raise RuntimeError(NO_RENDERER)


def _load_gl(name: str) -> Any:
    """The context class of one back end, tried on a small context."""
    os.environ["MUJOCO_GL"] = os.environ["PYOPENGL_PLATFORM"] = name
    context_class = importlib.import_module(f"mujoco.{name}").GLContext
    context_class(16, 16).free()
    return context_class


def _unload_gl() -> None:
    """PyOpenGL binds to one platform at import: forget it before the next try."""
    os.environ.pop("PYOPENGL_PLATFORM", None)
    os.environ.pop("MUJOCO_GL", None)
    for module in [m for m in sys.modules if m.split(".")[0] == "OpenGL"]:
        del sys.modules[module]
