"""The simulator: a soft block, a table and two rigid fingers, many environments at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from codesign_sim import kernels
from codesign_sim.checks import (
    SimulationError,
    require_finite,
    require_integers,
    require_not_negative,
    require_per_environment,
    require_positive,
)
from codesign_sim.finger_bank import FingerBank, Fingers
from codesign_sim.fingers import FingerTargets, motion, turn_angle
from codesign_sim.layout import Layout
from codesign_sim.material import Material, stable_time_step
from codesign_sim.mesh import SurfaceMesh
from codesign_sim.soft_object import SoftObject
from codesign_sim.stress import Stress, StressMeasure, summarise

CONTACT_STIFFNESS = 9e6  # Pa of pressure per metre of penetration
STIFFNESS_DAMPING = 2e-4  # s, beta: forces are evaluated at x + beta v
MASS_DAMPING = 20.0  # 1/s, of the motion relative to the best rigid motion
SAFETY = 0.9  # default time step, as a share of the stability limit
CELL_SHARE = 0.4  # of a cell, the farthest a node may move in a step
CONTACT_SKIN = 1e-3  # m that points travel before what is near an obstacle is found anew
FINGER_TRAVEL = 1e-3  # m per step, the cell of the fingers' distance grid
SETTLE_TIME = 0.25  # s
SETTLE_DAMPING = 150.0  # 1/s, about critical for the slowest vibration of the tofu
_SETTLE_ROUNDS = 6
_CALM = 2e-4  # m/s, of the fastest node of an object at rest
_CHUNK = 128  # steps per launch
_FINGERS, _TABLE = 3, 4  # obstacle bits


@dataclass(frozen=True, eq=False)
class ContactForces:
    """Contact forces in N on the object, world frame, averaged over the last `advance`.

    Attributes:
        left, right, table: (E, 3).
        finger_penetration: (E,) deepest contact point below a finger's surface at the end, metres;
            between the points a sharp edge cuts up to 0.7 mm deeper into the block.
        table_penetration: (E,) deepest contact point below the table, metres.
    """

    left: np.ndarray
    right: np.ndarray
    table: np.ndarray
    finger_penetration: np.ndarray
    table_penetration: np.ndarray


class Simulator:
    """Explicit co-rotational finite elements in Warp (paper section III-C).

    Args:
        block: the soft object, a `Block` or a `TetrahedralMesh`.
        fingers: (left, right) surfaces, or one such pair per environment, or None for no fingers.
        environments: number of independent copies E, at least 1.
        device: "cpu", or "cuda" for an NVIDIA GPU ("cuda:1" for the second).
        time_step: longest step in seconds; by default 0.9 of the stability limit, set at reset.
        table_height: z of the table in the world, metres; None for no table.
        gravity: (3,) m/s^2, world frame.
        stiffness_damping: beta in seconds; 0 for none.
        mass_damping: 1/s, acts on the motion relative to the block's rigid motion; 0 for none.
        contact_stiffness: penalty in Pa per metre.
    Raises:
        ValueError: an argument outside these limits, a finger mesh that is not watertight.
    """

    def __init__(
        self,
        block: SoftObject,
        fingers: Fingers | Sequence[Fingers] | None = None,
        environments: int = 1,
        device: str = "cpu",
        time_step: float | None = None,
        table_height: float | None = 0.0,
        gravity: tuple[float, float, float] = (0.0, 0.0, -9.81),
        stiffness_damping: float = STIFFNESS_DAMPING,
        mass_damping: float = MASS_DAMPING,
        contact_stiffness: float = CONTACT_STIFFNESS,
    ) -> None:
        if int(environments) != environments or environments < 1:
            raise ValueError(f"environments is {environments}; use a whole number of at least 1")
        require_not_negative("stiffness damping", stiffness_damping, "s")
        require_not_negative("mass damping", mass_damping, "1/s")
        if time_step is not None:
            require_positive("time step", time_step, (), "s")
        if table_height is not None:
            require_finite("table height", table_height, (), "m")
        require_positive("contact stiffness", contact_stiffness, (), "Pa/m")

        self.block = block
        self.environments = int(environments)
        self.table_height = table_height
        self.gravity = require_finite("gravity", gravity, (3,), "m/s^2")
        self.stiffness_damping = float(stiffness_damping)
        self.mass_damping = float(mass_damping)
        self.contact_stiffness = float(contact_stiffness)
        self.time = 0.0
        self.time_step = time_step or 0.0  # chosen at reset where the caller gave none
        self._given_time_step = time_step
        self._materials: list[Material] = []
        self._fingers_at: FingerTargets | None = None
        self._broken = ""
        self._launches: dict[str, Any] = {}

        self._layout = Layout(block, self.environments, device)
        self._kernels = kernels.kernels(self._layout.mode)
        self._origin = np.zeros((self.environments, 3))
        self._mean_forces = np.zeros((self.environments, 3, 3))
        scene: Any = kernels.Scene()
        scene.settings = self._layout.zeros(len(kernels.SETTINGS))
        self._scene = scene
        self._layout.describe_block(scene)
        self._layout.allocate(scene)
        self.pin([])
        self._bank = FingerBank(scene, self._layout, device)
        self.set_fingers(*_split(fingers))

    # ------------------------------------------------------------------ set-up

    def set_fingers(
        self,
        left: SurfaceMesh | Sequence[SurfaceMesh] | None,
        right: SurfaceMesh | Sequence[SurfaceMesh] | None,
        environments: Sequence[int] | np.ndarray | None = None,
    ) -> None:
        """Swaps the fingers between trials, in all environments or some.

        Clears the friction anchors on them. Swapped in all environments, fingers are next placed
        where the next target says; in some, the new ones stand where the old ones stood, and the
        other environments keep every bit of their state.

        Args:
            left, right: one mesh each, or one per environment (of those given); None for none.
            environments: (K,) different indices; None for all.
        Raises:
            ValueError: wrong indices, or as many meshes as neither one nor K.
        Warns:
            UserWarning: walls so thin that the block may pass through them.
        """
        every = environments is None
        chosen = np.arange(self.environments)
        if environments is not None:
            chosen = _indices(environments, self.environments)
        self._bank.load(chosen, _pairs(left, right, len(chosen)))
        self._fingers_at = None if every else self._within_limits(self._fingers_at)
        self._launches = {}

    def reset(
        self,
        materials: Material | Sequence[Material] = Material(),  # noqa: B008  (immutable)
        position: Sequence[float] | np.ndarray = (0.0, 0.0),
        yaw: float | np.ndarray = 0.0,
        fingers: FingerTargets | None = None,
        settle: bool = True,
    ) -> None:
        """Puts every block at rest on the table and the fingers at `fingers`.

        Args:
            materials: one for all, or one per environment.
            position: (2,) or (E, 2) world x, y of the centre of the base, metres.
            yaw: radians about world z, a number or (E,).
            fingers: where the fingers are; None leaves them away until the first target, at
                which they then appear.
            settle: let the block sink under its weight until it rests (fingers away); otherwise
                it starts undeformed, touching the table. Needs a table.
        Raises:
            ValueError: wrong shapes or values; a given time step above the stability limit.
        """
        everyone = np.arange(self.environments)
        materials = _per_environment(materials, self.environments)
        if fingers is not None:
            self._check_count(fingers)
        settle = settle and self.table_height is not None
        shapes = np.repeat(self._undeformed[None], self.environments, axis=0)
        if settle:
            shapes[:, :, 2] += self._sag(materials, self._undeformed[:, 2])
        self._choose_time_step(materials)
        self._broken = ""
        self._place(everyone, materials, position, yaw, shapes)
        self._fingers_at = None
        if settle:
            self._settle_to_rest()
        self._fingers_at = self._within_limits(fingers)
        self.time = 0.0

    def reset_some(
        self,
        environments: Sequence[int] | np.ndarray,
        materials: Material | Sequence[Material],
        shapes: np.ndarray,
        position: Sequence[float] | np.ndarray = (0.0, 0.0),
        yaw: float | np.ndarray = 0.0,
        fingers: FingerTargets | None = None,
    ) -> None:
        """Resets K environments to given shapes at rest; the others keep every bit of their state.

        Time goes on. Give the simulator a time step: its own choice gets shorter, for everyone,
        when a stiffer material comes in.

        Args:
            environments: (K,) different indices.
            materials: one for all K, or one each.
            shapes: (N, 3) or (K, N, 3) node positions, metres, with the centre of the base at the
                origin and yaw 0, for example from `rest_shape`.
            position, yaw: as for `reset`, per environment of the K.
            fingers: (K) where the fingers are; None only while all fingers are away.
        Raises:
            ValueError: wrong indices, shapes or values; a given time step above the limit.
            SimulationError: not reset yet, or the state stopped being finite.
        """
        self._require_reset()
        chosen = _indices(environments, self.environments)
        materials = _per_environment(materials, len(chosen))
        if (fingers is None) != (self._fingers_at is None):
            raise ValueError("fingers are away in some environments only; give them for all")
        if fingers is not None and len(fingers) != len(chosen):
            raise ValueError(f"got {len(fingers)} finger targets for {len(chosen)} environments")
        shapes = require_per_environment("shapes", shapes, len(chosen), self.block.nodes.shape, "m")
        every = list(self._materials)
        for index, material in zip(chosen, materials, strict=True):
            every[index] = material
        self._choose_time_step(every)
        self._place(chosen, materials, position, yaw, shapes)
        if fingers is not None and self._fingers_at is not None:
            placed = self._fingers_at.replaced(chosen, fingers)
            self._fingers_at = self._within_limits(placed)

    @property
    def _undeformed(self) -> np.ndarray:
        """Node positions (N, 3) of the block on the table as it was cut."""
        return self.block.nodes + np.array([0, 0, self.block.base_height])

    def _place(
        self,
        chosen: np.ndarray,
        materials: list[Material],
        position: Sequence[float] | np.ndarray,
        yaw: float | np.ndarray,
        shapes: np.ndarray,
    ) -> None:
        """Materials and shapes (K, N, 3) of K environments, resting where they are told to."""
        place = require_per_environment("block position", position, len(chosen), (2,), "m")
        turn = require_per_environment("yaw", yaw, len(chosen), (), "rad")
        self._materials = self._materials or list(materials)
        for index, material in zip(chosen, materials, strict=True):
            self._materials[index] = material
        values = [[*m.lame, m.density, m.friction] for m in materials]
        self._layout.overwrite(self._scene.materials, chosen, np.array(values))
        self._origin[chosen, :2] = place
        self._origin[chosen, 2] = 0.0 if self.table_height is None else self.table_height
        cos, sin = np.cos(turn)[:, None], np.sin(turn)[:, None]
        x, y, z = np.moveaxis(shapes, -1, 0)
        local = np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=-1)
        self._layout.overwrite(self._scene.reports, chosen, np.zeros((len(chosen), 12)))
        self._write_state(chosen, local, np.zeros_like(local))

    def _sag(self, materials: list[Material], z: np.ndarray) -> np.ndarray:
        """Vertical displacement (E, N) of a column under its own weight, on a penalty table."""
        weight = np.array([m.density for m in materials])[:, None] * -self.gravity[2]
        modulus = np.array([m.young_modulus for m in materials])[:, None]
        height = self.block.size[2]
        return -weight * ((height * z - z**2 / 2) / modulus + height / self.contact_stiffness)

    def _choose_time_step(self, materials: list[Material]) -> None:
        limit = min(
            stable_time_step(self.block, m, self.contact_stiffness, self.stiffness_damping)
            for m in set(materials)
        )
        if self._given_time_step is not None and self._given_time_step > limit:
            raise ValueError(
                f"time step is {self._given_time_step * 1e3:g} ms; the stability limit for this "
                f"mesh and material is {limit * 1e3:.3g} ms: use a shorter step or leave it out"
            )
        self.time_step = self._given_time_step or SAFETY * limit

    def pin(self, nodes: Sequence[int] | np.ndarray) -> None:
        """Holds nodes where they are, in every environment, until changed; [] frees all."""
        index = np.asarray(nodes, dtype=int)
        pinned = np.zeros(len(self.block.nodes), dtype=bool)
        pinned[index] = True
        self._scene.node_constants = self._layout.node_constants(pinned)
        velocities = self.velocities
        velocities[:, index] = 0
        self._scene.velocities.assign(self._layout.node_rows(velocities))
        self._launches = {}

    def set_loads(self, forces: np.ndarray) -> None:
        """Extra forces on the nodes, (N, 3) or (E, N, 3) in N, constant until changed."""
        shape = (self.environments, len(self.block.nodes), 3)
        forces = require_finite("loads", np.broadcast_to(forces, shape), shape, "N")
        self._scene.loads.assign(self._layout.node_rows(forces))

    def set_state(self, positions: np.ndarray, velocities: np.ndarray) -> None:
        """Node positions and velocities, (E, N, 3) each, world frame, m and m/s.

        Friction anchors are cleared.
        """
        self._require_reset()
        shape = (self.environments, len(self.block.nodes), 3)
        positions = require_finite("positions", positions, shape, "m")
        velocities = require_finite("velocities", velocities, shape, "m/s")
        everyone = np.arange(self.environments)
        self._write_state(everyone, positions - self._origin[:, None], velocities)

    def settle(self, duration: float = SETTLE_TIME, damping: float = SETTLE_DAMPING) -> None:
        """Brings the block to rest where it is, damping all its motion; time does not count.

        Args:
            duration: seconds, several times 1 / damping.
            damping: 1/s; best is twice the slowest vibration in rad/s.
        """
        self._require_reset()
        require_positive("duration", duration, (), "s")
        self._run(duration, None, require_not_negative("damping", damping, "1/s"), False)
        self._scene.velocities.zero_()

    def _settle_to_rest(self) -> None:
        """Settles as often as a slow object needs; the tofu does at once."""
        for _ in range(_SETTLE_ROUNDS):
            self._run(SETTLE_TIME, None, SETTLE_DAMPING, about_rigid=False)
            if np.abs(self.velocities).max() < _CALM:
                break
        self._scene.velocities.zero_()

    # ---------------------------------------------------------------- stepping

    def advance(self, duration: float, targets: FingerTargets | None = None) -> None:
        """Moves the fingers to `targets` at constant velocity while the block follows.

        The time step is shortened so that a whole number of steps makes up the duration.

        Args:
            duration: seconds, above 0.
            targets: where the fingers are at the end; None keeps them where they are. The first
                targets after a reset without fingers place them without a motion.
        Raises:
            ValueError: a target that is too far for the duration, or for other environments.
            SimulationError: not reset yet, or the state stopped being finite.
        """
        self._require_reset()
        require_positive("duration", duration, (), "s")
        if targets is not None:
            self._check_count(targets)
            if not self._bank:
                raise ValueError("finger targets given, but the simulator has no fingers")
            targets = self._within_limits(targets)
        self._run(duration, targets, self.mass_damping, about_rigid=True)
        self.time += duration

    def _run(
        self, duration: float, targets: FingerTargets | None, damping: float, about_rigid: bool
    ) -> None:
        substeps = max(1, int(np.ceil(duration / self.time_step - 1e-6)))
        dt = duration / substeps
        end = self._fingers_at if targets is None else targets
        start = end if self._fingers_at is None else self._fingers_at
        speed = self._finger_speed(start, end, duration, dt)
        obstacles = (_FINGERS if end is not None and self._bank else 0) | (
            _TABLE if self.table_height is not None else 0
        )
        if start is not None and end is not None:
            self._write_motion(start, end)
        settings = self._settings(dt, damping, about_rigid, obstacles, speed)
        totals = np.zeros((self.environments, 3, 3))
        for first in range(0, substeps, _CHUNK):
            settings["substeps"] = count = min(_CHUNK, substeps - first)
            # Forces act at x + beta v, so the fingers, too, are taken a time beta ahead.
            settings["fraction"] = (first * dt + self.stiffness_damping) / duration
            settings["fraction_step"] = dt / duration
            values = [settings[name] for name in kernels.SETTINGS]
            self._layout.write(self._scene.settings, np.array(values, dtype=np.float32))
            self._launch(self._kernels.advance)
            totals += count * self._report()[:, :, :3]
        self._mean_forces = totals / substeps
        self._fingers_at = end
        self._check_state()

    def _settings(
        self, dt: float, damping: float, about_rigid: bool, obstacles: int, finger_speed: float
    ) -> dict[str, float]:
        return {
            "time_step": dt,
            "stiffness_damping": self.stiffness_damping,
            "mass_damping": damping,
            "damp_about_rigid": float(about_rigid),
            "gravity_x": self.gravity[0],
            "gravity_y": self.gravity[1],
            "gravity_z": self.gravity[2],
            "top_speed": self.top_speed,
            "contact_stiffness": self.contact_stiffness,
            "obstacle_bits": obstacles,
            "finger_speed": finger_speed,
            "contact_skin": CONTACT_SKIN,
        }

    def _finger_speed(
        self, start: FingerTargets | None, end: FingerTargets | None, duration: float, dt: float
    ) -> float:
        if start is None or end is None:
            return 0.0
        reach = self._bank.radii + np.maximum(np.abs(start.width), np.abs(end.width)) / 2
        travel = (
            np.linalg.norm(end.position - start.position, axis=1)
            + np.abs(end.width - start.width) / 2
            + turn_angle(start.quaternion, end.quaternion) * reach
        )
        speed = float(travel.max()) / duration
        if speed * dt > FINGER_TRAVEL:
            raise ValueError(
                f"fingers move {speed * dt * 1e3:.2f} mm per step of {dt * 1e3:.3g} ms; the limit "
                f"is {FINGER_TRAVEL * 1e3:g} mm ({FINGER_TRAVEL / dt:.2g} m/s): "
                "move less or take longer"
            )
        return speed

    def _check_state(self) -> None:
        host = self._layout.host
        sums = host(self._scene.positions).sum() + host(self._scene.velocities).sum()
        if not np.isfinite(sums):
            self._broken = (
                f"the block's state is not finite after {self.time:g} s; reset, and use a shorter "
                f"time step than {self.time_step * 1e3:g} ms or gentler finger motions"
            )
            raise SimulationError(self._broken)

    # ----------------------------------------------------------------- results

    def stress(self, measure: StressMeasure = StressMeasure.COROTATED) -> Stress:
        """Von Mises stress of every tetrahedron now, and its summary (section III-C)."""
        self._require_reset()
        measure = StressMeasure(measure)
        self._launch(self._kernels.stress)
        which = 0 if measure is StressMeasure.CAUCHY else 1
        von_mises = self._layout.per_tetrahedron(self._scene.stresses, which)
        return summarise(von_mises, self.block.volumes, measure)

    def contact(self) -> ContactForces:
        """Contact forces of the last `advance`."""
        self._require_reset()
        depth = self._report()[:, :, 3]
        forces = self._mean_forces
        return ContactForces(
            left=forces[:, 0].copy(),
            right=forces[:, 1].copy(),
            table=forces[:, 2].copy(),
            finger_penetration=depth[:, :2].max(axis=1),
            table_penetration=depth[:, 2].copy(),
        )

    def elastic_forces(self) -> np.ndarray:
        """Elastic node forces (E, N, 3) in N at the present positions."""
        self._require_reset()
        self._launch(self._kernels.elastic)
        return self._layout.node_vectors(self._scene.forces)

    @property
    def top_speed(self) -> float:
        """Speed in m/s at which nodes are held, so that violent contact stays bounded."""
        self._require_reset()
        return CELL_SHARE * self.block.cell_size / self.time_step

    @property
    def positions(self) -> np.ndarray:
        """Node positions (E, N, 3), world frame, metres."""
        return self._layout.node_vectors(self._scene.positions) + self._origin[:, None]

    @property
    def velocities(self) -> np.ndarray:
        """Node velocities (E, N, 3), world frame, m/s."""
        return self._layout.node_vectors(self._scene.velocities)

    @property
    def tetrahedra(self) -> np.ndarray:
        """Node indices (T, 4)."""
        return self.block.tetrahedra

    @property
    def surface_triangles(self) -> np.ndarray:
        """Node indices (S, 3) of the block's surface, wound outwards."""
        return self.block.surface_triangles

    @property
    def surface_tetrahedra(self) -> np.ndarray:
        """Tetrahedron (S,) behind each surface triangle."""
        return self.block.surface_tetrahedra

    @property
    def rest_positions(self) -> np.ndarray:
        """Rest positions (N, 3), object frame at the block's centre, metres."""
        return self.block.nodes

    @property
    def fingers(self) -> FingerTargets | None:
        """Where the fingers really are now, widths held to the limits; None while away."""
        return self._fingers_at

    @property
    def closing_limits(self) -> np.ndarray:
        """Smallest widths (E,) in metres, at which the fingers touch each other.

        A narrower target closes the fingers as far as this and no farther (`closing_limit`):
        fingers that passed through each other would tear the block apart.
        """
        return self._bank.closing_limits.copy()

    def object_pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Best-fit rigid motion of the block: centre (E, 3) in metres, quaternion (E, 4) xyzw."""
        weights = self.block.node_volumes / self.block.volume
        now = self.positions
        centre = np.einsum("n,enk->ek", weights, now)
        moment = np.einsum("n,eni,nj->eij", weights, now - centre[:, None], self.block.nodes)
        u, _, vt = np.linalg.svd(moment)
        sign = np.sign(np.linalg.det(u @ vt))
        u[:, :, 2] *= sign[:, None]
        return centre, Rotation.from_matrix(u @ vt).as_quat()

    # ----------------------------------------------------------------- inside

    def _launch(self, kernel: wp.Kernel) -> None:
        if kernel.key not in self._launches:
            self._launches[kernel.key] = kernels.record(kernel, self._scene, self._layout.device)
        self._launches[kernel.key].launch()

    def _write_state(self, chosen: np.ndarray, local: np.ndarray, velocities: np.ndarray) -> None:
        """State (K, N, 3) of the chosen environments, in their own frames; clears anchors."""
        scene, layout = self._scene, self._layout
        layout.overwrite(scene.positions, chosen, layout.padded(local))
        layout.overwrite(scene.velocities, chosen, layout.padded(velocities))
        weights = self.block.node_volumes / self.block.volume
        layout.overwrite(scene.centres, chosen, np.einsum("n,enk->ek", weights, local))
        anchors = scene.anchors.size // (layout.groups * layout.lanes)
        layout.overwrite(scene.anchors, chosen, np.zeros((len(chosen), anchors)))
        self._mean_forces[chosen] = 0.0

    def _write_motion(self, start: FingerTargets, end: FingerTargets) -> None:
        values = motion(start, end)
        values[:, :3] -= self._origin
        self._layout.write(self._scene.motions, self._layout.grouped(values))

    def _report(self) -> np.ndarray:
        """Force and depth (E, 3 obstacles, 4) of the last launch."""
        return self._layout.ungrouped(self._scene.reports, 3, 4)

    def _within_limits(self, targets: FingerTargets | None) -> FingerTargets | None:
        """The targets, no narrower than the fingers allow."""
        limits = self._bank.closing_limits
        if targets is None or (targets.width >= limits).all():
            return targets
        width = np.maximum(targets.width, limits)
        return FingerTargets(targets.position, targets.quaternion, width)

    def _check_count(self, targets: FingerTargets) -> None:
        if len(targets) != self.environments:
            raise ValueError(
                f"finger targets are for {len(targets)} environments; there are {self.environments}"
            )

    def _require_reset(self) -> None:
        if self._broken:
            raise SimulationError(self._broken)
        if not self._materials:
            raise SimulationError("the simulator was not reset yet; call reset() first")


def _per_environment(materials: Material | Sequence[Material], count: int) -> list[Material]:
    materials = [materials] * count if isinstance(materials, Material) else list(materials)
    if len(materials) != count:
        raise ValueError(f"got {len(materials)} materials for {count} environments")
    return materials


def _indices(environments: Sequence[int] | np.ndarray, count: int) -> np.ndarray:
    index = require_integers("environments", environments, (-1,), 0)
    if len(np.unique(index)) != len(index) or (index >= count).any():
        raise ValueError(
            f"environments {index.tolist()}: use different indices from 0 to {count - 1}"
        )
    return index


def _split(fingers: Fingers | Sequence[Fingers] | None) -> tuple:
    if fingers is None:
        return None, None
    pairs = list(fingers)
    if len(pairs) == 2 and all(isinstance(mesh, SurfaceMesh) for mesh in pairs):
        return pairs[0], pairs[1]
    return [pair[0] for pair in pairs], [pair[1] for pair in pairs]  # type: ignore[index]


def _pairs(left, right, environments: int) -> Sequence[Fingers | None]:
    if left is None and right is None:
        return [None] * environments
    sides = []
    for name, side in (("left", left), ("right", right)):
        meshes = [side] * environments if isinstance(side, SurfaceMesh) else list(side or [])
        if len(meshes) != environments or not all(isinstance(m, SurfaceMesh) for m in meshes):
            raise ValueError(
                f"{name} finger: give one SurfaceMesh, or one for each of the {environments} "
                "environments"
            )
        sides.append(meshes)
    return list(zip(*sides, strict=True))
