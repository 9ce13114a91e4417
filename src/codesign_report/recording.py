"""A recorded trial as plain numpy arrays."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from codesign_policy.domain import TrialDomain

GRAVITY = 9.81
"""[m/s^2]"""

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class TriangleMesh:
    """Vertices (V, 3) [m] and triangles (F, 3), counter-clockwise seen from outside."""

    vertices: Floats
    triangles: Ints


@dataclass(frozen=True)
class SoftBody:
    """Topology and rest shape of the object; codesign_interfaces/SoftBodyMesh.

    Attributes:
        rest_positions: (N, 3), origin at the block's centre [m].
        tetrahedra: (E, 4) node indices.
        surface_triangles: (S, 3) node indices, counter-clockwise seen from outside.
        surface_tetrahedra: (S,) the tetrahedron behind each surface triangle.
    """

    rest_positions: Floats
    tetrahedra: Ints
    surface_triangles: Ints
    surface_tetrahedra: Ints

    @property
    def volume(self) -> float:
        """Of the rest shape [m^3]."""
        corner, *others = np.moveaxis(self.rest_positions[self.tetrahedra], 1, 0)
        edges = np.stack([other - corner for other in others], axis=1)
        return float(np.linalg.det(edges).sum() / 6.0)


@dataclass(frozen=True)
class StressSeries:
    """Stress and finger forces over time; codesign_interfaces/Stress.

    Attributes:
        times: (T,) [s].
        top10, median: von Mises stress, (T,) [Pa].
        von_mises: per tetrahedron, (T, E) [Pa].
        left_force, right_force: of the finger on the object, in link_base, (T, 3) [N].
    """

    times: Floats
    top10: Floats
    median: Floats
    von_mises: npt.NDArray[np.float32]
    left_force: Floats
    right_force: Floats


@dataclass(frozen=True)
class MotionSeries:
    """Deformed shape and finger poses over time; codesign_interfaces/SimulationState.

    Attributes:
        times: (T,) [s].
        positions: of the nodes in link_base, (T, N, 3) [m].
        left_pose, right_pose: of the finger meshes in link_base, (T, 7): x y z [m], qx qy qz qw.
    """

    times: Floats
    positions: npt.NDArray[np.float32]
    left_pose: Floats
    right_pose: Floats


@dataclass(frozen=True)
class PoseEstimates:
    """Where a camera saw the object, in a trial whose true poses are known as well.

    Attributes:
        times: (P,) [s].
        errors: estimated minus true position in link_base, (P, 3) [m].
        rejected: times of the pictures in which it was not found, (R,) [s].
    """

    times: Floats
    errors: Floats
    rejected: Floats

    @property
    def distances(self) -> Floats:
        """Between estimated and true position, (P,) [m]."""
        return np.asarray(np.linalg.norm(self.errors, axis=1))

    def percentile(self, share: float) -> float:
        """The distance below which this share of the estimates lies, 0 to 100 [m]."""
        return float(np.percentile(self.distances, share))


@dataclass(frozen=True)
class TrialRecording:
    """Everything a report needs of one trial. Time 0: the policy's start, or the first sample.

    Attributes:
        bag: the rosbag2 folder (or file) it was read from.
        gripper, seed: the trial's label; seed -1: not recorded.
        domain: material and placement.
        soft_body, left_finger, right_finger: geometry; finger meshes in their own frame.
        stress, motion: simulation truth.
        object_times, object_positions: the object's pose, (P,) [s] and (P, 3) in link_base [m];
            the true one where a simulator told it beside a camera.
        gripper_times, gripper_width: /gripper_state, (G,) [s] and gap (G,) [m]; may be empty.
        estimates: of a camera, where there was one in a simulated cell.
        start: stamp of time 0 [ns].
    """

    bag: Path
    gripper: str
    seed: int
    domain: TrialDomain
    soft_body: SoftBody
    left_finger: TriangleMesh
    right_finger: TriangleMesh
    stress: StressSeries
    motion: MotionSeries
    object_times: Floats
    object_positions: Floats
    gripper_times: Floats
    gripper_width: Floats
    estimates: PoseEstimates | None = None
    start: int = 0

    @property
    def name(self) -> str:
        """Of the trial and its files, e.g. "stock-seed0"."""
        return self.bag.stem if self.bag.is_file() else self.bag.name

    @property
    def weight(self) -> float:
        """Of the object [N]; NaN if its density was not recorded."""
        return self.soft_body.volume * self.domain.density * GRAVITY

    @property
    def object_height(self) -> Floats:
        """Height of the object's centre at the stress samples, (T,) [m]."""
        return np.interp(self.stress.times, self.object_times, self.object_positions[:, 2])
