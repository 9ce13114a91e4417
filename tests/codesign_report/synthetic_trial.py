"""A made-up but plausible trial: as arrays, and as a rosbag2 folder in the graph's own messages."""

import itertools
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import trimesh
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from codesign_report.recording import GRAVITY, SoftBody, TriangleMesh

MESSAGES = Path(__file__).parents[2] / "ros_ws/src/codesign_interfaces/msg"
START = 1_700_000_000_250_000_000  # ns; stamps are not zero-based
POLICY_START = 0.2  # s
SIZE = np.array([0.03, 0.05, 0.04])
CENTER = np.array([0.45, 0.05])
DOMAIN = {
    "young_modulus": 9000.0,
    "poisson_ratio": 0.31,
    "density": 1030.0,
    "friction": 0.5,
    "x": CENTER[0],
    "y": CENTER[1],
    "yaw": 0.3,
}


def block(cells=(4, 6, 5)):
    """The tofu as 6 tetrahedra per cell."""
    axes = [np.linspace(-s / 2, s / 2, n + 1) for s, n in zip(SIZE, cells, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(len(nodes)).reshape([n + 1 for n in cells])
    tets = []
    for corner in itertools.product(*map(range, cells)):
        for path in itertools.permutations(range(3)):
            at = np.array(corner)
            steps = [at.copy()]
            for axis in path:
                at[axis] += 1
                steps.append(at.copy())
            tets.append([number[tuple(s)] for s in steps])
    tets = np.array(tets)
    e = nodes[tets[:, 1:]] - nodes[tets[:, :1]]
    flipped = np.linalg.det(e) < 0
    tets[flipped] = tets[flipped][:, [0, 2, 1, 3]]
    faces = tets[:, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]].reshape(-1, 3)
    owner = np.repeat(np.arange(len(tets)), 4)
    _, first, count = np.unique(np.sort(faces, 1), axis=0, return_index=True, return_counts=True)
    outer = first[count == 1]
    return SoftBody(nodes, tets, faces[outer], owner[outer])


def fingers():
    """Two flat plates, 7 mm thick."""
    left = trimesh.creation.box((0.03, 0.007, 0.045))
    left.apply_translation((0.0, 0.0035, -0.0175))
    mirrored = left.vertices * [1.0, -1.0, 1.0]
    return (
        TriangleMesh(np.asarray(left.vertices), np.asarray(left.faces)),
        TriangleMesh(mirrored, np.asarray(left.faces)[:, ::-1].copy()),
    )


def smoothstep(t, start, stop):
    x = np.clip((t - start) / (stop - start), 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


@dataclass
class SyntheticTrial:
    """Approach to 1.2 s, close to 2 s, lift until 3.5 s, hold."""

    gripper: str = "stock"
    seed: int = 3
    duration: float = 5.0
    rate: float = 20.0
    lift: float = 0.1
    squeeze: float = 0.004  # of each finger [m]
    stiffness: float = 3200.0  # top-10 % stress at full squeeze [Pa]
    cells: tuple[int, int, int] = (4, 6, 5)
    leave_out: tuple[str, ...] = ()
    body: SoftBody = field(init=False)

    def __post_init__(self):
        self.body = block(self.cells)
        self.fingers = fingers()
        self.times = np.arange(0.0, self.duration + 1e-9, 1.0 / self.rate)
        yaw = DOMAIN["yaw"]
        self.turn = np.array(
            [[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]]
        )

    @property
    def weight(self):
        return float(np.prod(SIZE) * DOMAIN["density"] * GRAVITY)

    def grip(self, t):
        return smoothstep(t, 1.2, 2.0)

    def rise(self, t):
        return self.lift * smoothstep(t, 2.0, 3.5)

    def gap(self, t):
        return 0.08 + (SIZE[1] - 2 * self.squeeze - 0.08) * smoothstep(t, 0.6, 2.0)

    def in_contact(self, t):
        return self.grip(t) > 0.02

    def height(self, t):
        return SIZE[2] / 2 + self.rise(t)

    def positions(self, t):
        rest, grip = self.body.rest_positions, self.grip(t)
        x, y, z = (2 * rest / SIZE).T
        pressed = np.exp(-((z + 0.1) ** 2) / 0.5) * (1.0 - 0.15 * x**2)
        local = rest.copy()
        local[:, 1] -= grip * self.squeeze * np.sign(y) * np.abs(y) ** 1.5 * pressed
        local[:, 0] *= 1.0 + 0.06 * grip * pressed * (1 - 0.5 * np.abs(y))
        local[:, 2] += 0.0015 * grip * (z > 0) * z * (1 - y**2)
        local[:, 2] -= 0.002 * self.rise(t) / 0.1 * (1 - y**2)
        return local @ self.turn.T + [*CENTER, self.height(t)]

    def von_mises(self, t):
        middle = self.body.rest_positions[self.body.tetrahedra].mean(axis=1)
        x, y, z = (2 * middle / SIZE).T
        near = np.exp(-((1 - np.abs(y)) ** 2) / 0.15) * np.exp(-((z + 0.1) ** 2) / 0.3)
        load = self.grip(t) * (0.8 + 0.2 * self.rise(t) / max(self.lift, 1e-9))
        return 120.0 * (1 - z) + load * self.stiffness * (0.15 + 1.1 * near * (1 - 0.2 * x**2))

    def forces(self, t):
        if not self.in_contact(t):
            return np.zeros(3), np.zeros(3)
        push = self.turn @ [0.0, 1.4 * self.grip(t), 0.0]
        up = np.array([0.0, 0.0, self.weight / 2 if self.rise(t) > 0 else 0.0])
        return up - push, up + push

    def pose(self, t, side):
        drop = 0.12 * (1.0 - smoothstep(t, 0.0, 0.9))
        centre = np.array([*CENTER, 0.018 + self.rise(t) + drop])
        # z down, and y of the gripper along y of the block: half a turn about the block's y.
        half = DOMAIN["yaw"] / 2
        quaternion = np.array([-np.sin(half), np.cos(half), 0.0, 0.0])
        offset = self.turn @ [0.0, side * self.gap(t) / 2, 0.0]
        return np.concatenate([centre + offset, quaternion])


def typestore(edit=lambda _, text: text):
    """The graph's messages; `edit(name, text)` may change a definition."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types = {}
    for path in sorted(MESSAGES.glob("*.msg")):
        types.update(
            get_types_from_msg(
                edit(path.stem, path.read_text()), f"codesign_interfaces/msg/{path.stem}"
            )
        )
    store.register(types)
    return store


def qos(latched):
    never = QosTime(2147483647, 4294967295)
    return Qos(
        QosHistory.KEEP_LAST,
        1,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        never,
        never,
        QosLiveliness.AUTOMATIC,
        never,
        False,
    )


class BagWriter:
    """Writes one trial; message objects are built by keyword in `messages`."""

    def __init__(self, trial):
        self.trial = trial
        self.store = typestore()

    def make(self, kind, **fields):
        package, name = kind.split("/")
        return self.store.types[f"{package}/msg/{name}"](**fields)

    def stamp(self, t):
        nanoseconds = 0 if t is None else START + round(t * 1e9)
        return self.make(
            "builtin_interfaces/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9
        )

    def header(self, t, frame="link_base"):
        return self.make("std_msgs/Header", stamp=self.stamp(t), frame_id=frame)

    def vector(self, values):
        x, y, z = map(float, values)
        return self.make("geometry_msgs/Vector3", x=x, y=y, z=z)

    def to_pose(self, values):
        x, y, z, qx, qy, qz, qw = map(float, values)
        return self.make(
            "geometry_msgs/Pose",
            position=self.make("geometry_msgs/Point", x=x, y=y, z=z),
            orientation=self.make("geometry_msgs/Quaternion", x=qx, y=qy, z=qz, w=qw),
        )

    def to_mesh(self, mesh):
        return self.make(
            "shape_msgs/Mesh",
            triangles=[
                self.make("shape_msgs/MeshTriangle", vertex_indices=t.astype(np.uint32))
                for t in mesh.triangles
            ],
            vertices=[
                self.make("geometry_msgs/Point", x=v[0], y=v[1], z=v[2])
                for v in mesh.vertices.tolist()
            ],
        )

    def domain(self):
        return self.make("codesign_interfaces/TrialDomain", **DOMAIN)

    def messages(self):
        """(time, topic, type, message) in no particular order."""
        trial = self.trial
        yield 0.0, "/soft_body_mesh", "codesign_interfaces/SoftBodyMesh", self.soft_body_mesh()
        yield 0.0, "/finger_design", "codesign_interfaces/FingerDesign", self.finger_design()
        for t in trial.times:
            yield t, "/stress", "codesign_interfaces/Stress", self.stress(t)
            yield t, "/simulation_state", "codesign_interfaces/SimulationState", self.state(t)
        for t in np.arange(0.0, trial.duration + 1e-9, 0.02):
            yield t, "/object_pose", "geometry_msgs/PoseStamped", self.object_pose(t)
            yield t, "/gripper_state", "codesign_interfaces/GripperState", self.gripper_state(t)
        for t, state in ((0.0, 1), (0.21, 2), (trial.duration + 0.3, 3)):
            yield t, "/trial_state", "codesign_interfaces/TrialState", self.trial_state(t, state)

    def soft_body_mesh(self):
        body = self.trial.body
        return self.make(
            "codesign_interfaces/SoftBodyMesh",
            header=self.header(0.0, "tofu"),
            rest_positions=body.rest_positions.astype(np.float32).ravel(),
            tetrahedra=body.tetrahedra.astype(np.uint32).ravel(),
            surface_triangles=body.surface_triangles.astype(np.uint32).ravel(),
            surface_tetrahedra=body.surface_tetrahedra.astype(np.uint32),
            domain=self.domain(),
        )

    def finger_design(self):
        left, right = self.trial.fingers
        return self.make(
            "codesign_interfaces/FingerDesign",
            header=self.header(0.0, ""),
            name=self.trial.gripper,
            cage="",
            parameters=np.zeros(0),
            left=self.to_mesh(left),
            right=self.to_mesh(right),
            min_width=0.0,
            max_width=0.084,
            mount="stock-m3x2",
            content_hash="",
        )

    def stress(self, t):
        values = self.trial.von_mises(t).astype(np.float32)
        left, right = self.trial.forces(t)
        return self.make(
            "codesign_interfaces/Stress",
            header=self.header(t),
            measure=0,
            top10_mean=float(np.sort(values)[-len(values) // 10 :].mean()),
            mean=float(values.mean()),
            median=float(np.median(values)),
            von_mises=values,
            left_force=self.vector(left),
            right_force=self.vector(right),
            table_force=self.vector([0.0, 0.0, 0.0]),
            finger_penetration=1e-4,
            table_penetration=0.0,
            CAUCHY=0,
            COROTATED=1,
        )

    def state(self, t):
        return self.make(
            "codesign_interfaces/SimulationState",
            header=self.header(t),
            positions=self.trial.positions(t).astype(np.float32).ravel(),
            left_finger=self.to_pose(self.trial.pose(t, 1.0)),
            right_finger=self.to_pose(self.trial.pose(t, -1.0)),
        )

    def object_pose(self, t):
        half = DOMAIN["yaw"] / 2
        pose = [*CENTER, self.trial.height(t), 0.0, 0.0, np.sin(half), np.cos(half)]
        return self.make(
            "geometry_msgs/PoseStamped", header=self.header(t), pose=self.to_pose(pose)
        )

    def gripper_state(self, t):
        return self.make(
            "codesign_interfaces/GripperState",
            header=self.header(t),
            width=float(self.trial.gap(t)),
            velocity=0.0,
            target_width=float(self.trial.gap(t)),
            drive_joint=0.0,
            moving=False,
        )

    def trial_state(self, t, state):
        nan = float("nan")
        return self.make(
            "codesign_interfaces/TrialState",
            header=self.header(t),
            state=state,
            message="",
            gripper=self.trial.gripper,
            seed=self.trial.seed,
            elapsed=t,
            started=self.stamp(POLICY_START) if state == 3 else self.stamp(None),
            ended=self.stamp(self.trial.duration) if state == 3 else self.stamp(None),
            domain=self.domain(),
            metrics=self.make(
                "codesign_interfaces/TrialMetrics",
                success=False,
                top10_stress=nan,
                median_stress=nan,
                peak_lift=nan,
                held_force=nan,
                interaction_time=nan,
                score=0.0,
            ),
            IDLE=0,
            PREPARING=1,
            RUNNING=2,
            FINISHED=3,
            FAILED=4,
        )


def write_bag(path, trial=None, writer_class=BagWriter):
    """A rosbag2 folder (MCAP, format 9) with type hashes and offered QoS, received 5 ms late."""
    writer = writer_class(trial or SyntheticTrial())
    messages = [m for m in writer.messages() if m[1] not in writer.trial.leave_out]
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connections = {}
        for t, topic, kind, message in sorted(messages, key=lambda m: m[0]):
            name = kind.replace("/", "/msg/")
            if topic not in connections:
                latched = topic in ("/soft_body_mesh", "/finger_design")
                connections[topic] = bag.add_connection(
                    topic, name, typestore=writer.store, offered_qos_profiles=[qos(latched)]
                )
            data = writer.store.serialize_cdr(message, name)
            bag.write(connections[topic], START + round((t + 0.005) * 1e9), data)
    return Path(path)
