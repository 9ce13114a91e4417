"""Between numpy arrays and messages."""

import array
import math
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from codesign_interfaces.msg import ControlAction as ControlActionMsg
from codesign_interfaces.msg import FingerDesign
from codesign_interfaces.msg import PolicySetup as PolicySetupMsg
from codesign_interfaces.msg import TrialDomain as TrialDomainMsg
from geometry_msgs.msg import Point, Pose, Quaternion, Vector3
from numpy.typing import NDArray
from shape_msgs.msg import Mesh, MeshTriangle

from codesign_design.finger_pair import FingerPair, TriangleMesh, check_surface
from codesign_policy.domain import TrialDomain
from codesign_policy.policy import PolicySetup
from codesign_policy.task import ControlAction


def floats(values: NDArray[Any]) -> array.array:
    """A float32[] field; a flat copy."""
    return array.array("f", np.ascontiguousarray(values, dtype=np.float32).tobytes())


def indices(values: NDArray[Any]) -> array.array:
    """A uint32[] field; a flat copy."""
    return array.array("I", np.ascontiguousarray(values, dtype=np.uint32).tobytes())


def vector3(values: NDArray[Any]) -> Vector3:
    """(3,) as a message."""
    return Vector3(x=float(values[0]), y=float(values[1]), z=float(values[2]))


def from_xyz(message: Any) -> NDArray[np.float64]:
    """A Vector3 or Point as (3,)."""
    return np.array([message.x, message.y, message.z])


def from_quaternion(message: Quaternion) -> NDArray[np.float64]:
    """A Quaternion as (4,), x y z w."""
    return np.array([message.x, message.y, message.z, message.w])


def pose(position: NDArray[Any], quaternion: NDArray[Any]) -> Pose:
    """Position (3,) [m] and quaternion (4,) x y z w as a message."""
    x, y, z, w = (float(v) for v in quaternion)
    return Pose(
        position=Point(x=float(position[0]), y=float(position[1]), z=float(position[2])),
        orientation=Quaternion(x=x, y=y, z=z, w=w),
    )


def action_message(
    action: ControlAction,
    sequence: int,
    stamp: Time,
    *,
    object_stamp: Time,
    tcp_stamp: Time,
    gripper_stamp: Time,
) -> ControlActionMsg:
    """An action as a message: its number, when it is sent, and the stamps of what it answers."""
    message = ControlActionMsg(
        observation_stamp=object_stamp,
        tcp_stamp=tcp_stamp,
        gripper_stamp=gripper_stamp,
        sequence=sequence,
        translation=vector3(action.translation),
        rotation=vector3(action.rotation),
        width=action.width,
    )
    message.header.stamp = stamp
    message.header.frame_id = "link_base"
    return message


def setup_message(setup: PolicySetup, fingers: str) -> PolicySetupMsg:
    """What a policy is made of, with the content hash of the fingers; without a stamp."""
    return PolicySetupMsg(
        policy=setup.policy,
        file_hash=setup.file_hash,
        file=array.array("B", setup.file),
        setting_names=list(setup.settings),
        setting_values=array.array("d", setup.settings.values()),
        fingers=fingers,
    )


def domain_message(domain: TrialDomain) -> TrialDomainMsg:
    """The library's domain as a message."""
    return TrialDomainMsg(**{k: float(v) for k, v in vars(domain).items()})


def domain_from(message: TrialDomainMsg) -> TrialDomain:
    """A message as the library's domain."""
    return TrialDomain(**{k: getattr(message, k) for k in TrialDomain.__dataclass_fields__})


def unspecified_domain() -> TrialDomainMsg:
    """A request in which everything is drawn from the seed."""
    return TrialDomainMsg(**dict.fromkeys(TrialDomain.__dataclass_fields__, math.nan))


def mesh_message(mesh: TriangleMesh) -> Mesh:
    """A surface as shape_msgs/Mesh [m]."""
    return Mesh(
        triangles=[MeshTriangle(vertex_indices=face) for face in mesh.faces.astype(np.uint32)],
        vertices=[Point(x=x, y=y, z=z) for x, y, z in mesh.vertices.tolist()],
    )


def mesh_from(message: Mesh) -> TriangleMesh:
    """shape_msgs/Mesh [m] as a surface."""
    vertices = np.array([[p.x, p.y, p.z] for p in message.vertices]).reshape(-1, 3)
    faces = np.array([t.vertex_indices for t in message.triangles], dtype=np.int32).reshape(-1, 3)
    return TriangleMesh(vertices, faces)


def design_message(fingers: FingerPair) -> FingerDesign:
    """A finger pair as a message, without a stamp."""
    return FingerDesign(
        name=fingers.name,
        cage=fingers.cage,
        parameters=[float(p) for p in fingers.parameters],
        left=mesh_message(fingers.left),
        right=mesh_message(fingers.right),
        min_width=fingers.min_width,
        max_width=fingers.max_width,
        mount=fingers.mount,
        content_hash=fingers.content_hash,
    )


def design_from(message: FingerDesign) -> FingerPair:
    """A message as a finger pair.

    Raises:
        ValueError: the content hash does not fit the meshes, a mesh that cannot be a finger (see
            `check_surface`), or a limit that is not finite.
    """
    fingers = FingerPair(
        name=message.name,
        left=mesh_from(message.left),
        right=mesh_from(message.right),
        min_width=message.min_width,
        max_width=message.max_width,
        cage=message.cage,
        parameters=tuple(message.parameters),
        mount=message.mount,
    )
    for side, mesh in (("left", fingers.left), ("right", fingers.right)):
        check_surface(mesh, f"{side} finger {fingers.name!r}")
    if not 0.0 <= fingers.min_width < fingers.max_width < math.inf:
        raise ValueError(
            f"finger {fingers.name!r}: gap {fingers.min_width}..{fingers.max_width} m, must be "
            "0 <= min < max"
        )
    if message.content_hash != fingers.content_hash:
        raise ValueError(
            f"finger {fingers.name!r}: content hash {message.content_hash[:12]} is not that of "
            f"its meshes ({fingers.content_hash[:12]})"
        )
    return fingers
