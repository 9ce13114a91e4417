"""Whether a log of joint set-points kept every limit: an independent check.

It shares the limits and the shapes with the servo, and nothing of how they are computed:
kinematics, distances and derivatives are its own, in numpy over the whole log.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import asdict, dataclass, replace

import numpy as np

from codesign_control.capsules import arm_capsules, hand_capsules, placed, watched_pairs
from codesign_control.config import ServoConfig
from codesign_control.hand import TCP_FROM_FLANGE, Hand
from codesign_control.xarm7 import urdf

SLACK = 1e-6  # relative, of derivatives: they magnify the last digit of a double
LENGTH_SLACK = 1e-7  # m
ROWS = 4000  # of a log at a time: bounds the memory
NOT_OVER_TABLE = ("link_base", "link1", "fingers")  # fixed, or checked by their corners


@dataclass(frozen=True)
class Finding:
    """One limit over a log.

    worst: the value nearest to the limit or farthest beyond it; violations: how many values are
    beyond. At most `limit`, or at least it where `at_least`.
    """

    name: str
    unit: str
    limit: float
    at_least: bool
    worst: float
    violations: int


@dataclass(frozen=True)
class LimitReport:
    """What became of every limit in a log of `set_points`."""

    set_points: int
    findings: dict[str, Finding]

    @property
    def violations(self) -> int:
        """Of all limits together."""
        return sum(finding.violations for finding in self.findings.values())

    def merged(self, other: LimitReport) -> LimitReport:
        """Of two logs."""
        findings = dict(self.findings)
        for name, new in other.findings.items():
            old = findings.get(name, new)
            worse = min if new.at_least else max
            count = new.violations + (old.violations if name in findings else 0)
            findings[name] = replace(new, worst=worse(old.worst, new.worst), violations=count)
        return LimitReport(self.set_points + other.set_points, findings)

    def to_dict(self) -> dict[str, object]:
        """Plain data for JSON."""
        return {
            "set_points": self.set_points,
            "violations": self.violations,
            "limits": [asdict(finding) for finding in self.findings.values()],
        }


def check_log(
    times: np.ndarray,
    positions: np.ndarray,
    config: ServoConfig | None = None,
    hand: Hand | None = None,
    widths: np.ndarray | None = None,
) -> LimitReport:
    """Checks a log of joint set-points.

    times: (n,) s, when each one is meant for, rising; keep them small, for their last digits show
    in the jerk. positions: (n, 7) rad, n >= 4; where a log starts, repeat its first posture three
    times if the arm stood there. widths: (n,) m, the gap at each one; without it the fingers are
    checked against the arm, wherever the gripper holds them, but not against the table.

    Derivatives are divided differences, so unequal steps are exact: by the mean value theorem no
    motion that keeps its limits can exceed them here.
    Raises ValueError for other shapes, times that do not rise, or a number that is not finite.
    """
    config, hand = config or ServoConfig(), hand or Hand()
    times, positions = np.asarray(times, dtype=float), np.asarray(positions, dtype=float)
    if positions.ndim != 2 or positions.shape[1] != 7 or len(positions) < 4:
        raise ValueError(f"positions: shape {positions.shape}, expected (n, 7), n at least 4")
    if times.shape != (len(positions),) or not (np.diff(times) > 0).all():
        raise ValueError(f"times: shape {times.shape}, expected {len(positions)} rising numbers")
    if not (np.isfinite(positions).all() and np.isfinite(times).all()):
        raise ValueError("log: holds numbers that are not finite")
    findings = _joints(times, positions, config)
    tcp = []
    for start in range(0, len(positions), ROWS):
        rows = slice(start, start + ROWS)
        links = link_placements(positions[rows])
        tcp.append(_tcp(links))
        findings += _distances(links, config, hand)
        if widths is not None:
            height = _finger_height(links, hand, np.asarray(widths, dtype=float)[rows])
            findings.append(_at_least("finger height", "m", config.table_height, height))
    findings += _cartesian(times, np.concatenate(tcp), config)
    report = LimitReport(0, {})
    for finding in findings:
        report = report.merged(LimitReport(0, {finding.name: finding}))
    return replace(report, set_points=len(positions))


def _joints(times: np.ndarray, positions: np.ndarray, config: ServoConfig) -> list[Finding]:
    limits = [joint.find("limit") for joint in _revolute_joints()]
    lower = np.array([float(limit.get("lower", "nan")) for limit in limits if limit is not None])
    upper = np.array([float(limit.get("upper", "nan")) for limit in limits if limit is not None])
    room = np.minimum(positions - lower, upper - positions)
    velocity = np.diff(positions, axis=0) / np.diff(times)[:, None]
    acceleration = 2.0 * np.diff(velocity, axis=0) / (times[2:] - times[:-2])[:, None]
    jerk = 3.0 * np.diff(acceleration, axis=0) / (times[3:] - times[:-3])[:, None]
    return [
        _at_least("joint room", "rad", 0.0, room),
        _at_most("joint velocity", "rad/s", config.joint_velocity, velocity),
        _at_most("joint acceleration", "rad/s^2", config.joint_acceleration, acceleration),
        _at_most("joint jerk", "rad/s^3", config.joint_jerk, jerk),
    ]


def _cartesian(times: np.ndarray, tcp: np.ndarray, config: ServoConfig) -> list[Finding]:
    room = np.minimum(tcp - config.box_lower, config.box_upper - np.asarray(tcp))
    speed = np.linalg.norm(np.diff(tcp, axis=0), axis=1) / np.diff(times)
    return [
        _at_least("box room", "m", 0.0, room),
        _at_most("TCP speed", "m/s", config.tcp_speed_limit, speed),
    ]


def _distances(links: Placements, config: ServoConfig, hand: Hand) -> list[Finding]:
    capsules = arm_capsules() + hand_capsules(hand)
    ends = [
        [links[link][0] @ end + links[link][1] for end in (start, stop)]
        for link, start, stop in map(placed, capsules)
    ]
    points = np.array(ends).transpose(2, 0, 1, 3)  # (n, C, 2, 3)
    radii = np.array([capsule.radius for capsule in capsules])
    first, second = np.array(watched_pairs(capsules)).T
    apart = segment_distance(points[:, first], points[:, second]) - radii[first] - radii[second]
    over = [i for i, capsule in enumerate(capsules) if capsule.link not in NOT_OVER_TABLE]
    height = points[:, over][..., 2].min(axis=2) - radii[over] - config.table_height
    return [
        _at_least("self distance", "m", config.self_collision_margin, apart),
        _at_least("link height over the table", "m", config.table_margin, height),
    ]


def _finger_height(links: Placements, hand: Hand, widths: np.ndarray) -> np.ndarray:
    """(n,) m: z of the fingers' lowest corner at a gap of (n,) m."""
    down, gripper = links["gripper_base_link"][0][:, 2], hand.gripper
    widths = np.array([gripper.clip(width) for width in widths])
    forward = np.array([gripper.finger_z(width) for width in widths])
    left, right = hand.fingers.corners
    aside = down[:, 1] * widths / 2.0
    lowest = np.minimum((down @ left.T).min(axis=1) + aside, (down @ right.T).min(axis=1) - aside)
    return np.asarray(_tcp(links)[:, 2] + down[:, 2] * forward + lowest)


# Kinematics ------------------------------------------------------------------------------------

Placements = dict[str, tuple[np.ndarray, np.ndarray]]  # link: (n, 3, 3) rotations, (n, 3) m


def link_placements(positions: np.ndarray) -> Placements:
    """Placement of every link in `link_base` along (n, 7) rad: rotations and origins [m]."""
    count = len(positions)
    rotation, origin = np.repeat(np.eye(3)[None], count, axis=0), np.zeros((count, 3))
    placements = {"link_base": (rotation, origin)}
    for joint, angles in zip(_revolute_joints(), np.transpose(positions), strict=True):
        origin = origin + rotation @ _numbers(joint, "xyz")
        rotation = rotation @ _rpy(_numbers(joint, "rpy")) @ _about_z(angles)
        child = joint.find("child")
        placements[str(child.get("link")) if child is not None else ""] = (rotation, origin)
    placements["gripper_base_link"] = placements["link7"]
    return placements


def _tcp(links: Placements) -> np.ndarray:
    rotation, origin = links["gripper_base_link"]
    return origin + TCP_FROM_FLANGE * rotation[:, :, 2]


def _revolute_joints() -> list[ElementTree.Element]:
    """joint1..joint7; all of them turn about their own z axis."""
    joints = ElementTree.fromstring(urdf()).iter("joint")
    return [joint for joint in joints if joint.get("type") == "revolute"]


def _numbers(joint: ElementTree.Element, key: str) -> np.ndarray:
    origin = joint.find("origin")
    return np.array(str(origin.get(key)).split() if origin is not None else [0.0] * 3, dtype=float)


def _about_z(angles: np.ndarray) -> np.ndarray:
    turned = np.zeros((len(angles), 3, 3))
    turned[:, 0, 0] = turned[:, 1, 1] = np.cos(angles)
    turned[:, 1, 0] = np.sin(angles)
    turned[:, 0, 1], turned[:, 2, 2] = -turned[:, 1, 0], 1.0
    return turned


def _rpy(angles: np.ndarray) -> np.ndarray:
    """URDF: about fixed x, then y, then z."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(angles), np.cos(angles)
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return np.asarray(about_z @ about_y @ about_x)


# Distances -------------------------------------------------------------------------------------


def segment_distance(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(...,) m between segments given by their ends, (..., 2, 3) m each.

    Two segments are nearest at an end of one of them, or where the common normal of their lines
    meets both.
    """
    nearest = np.minimum.reduce(
        [_point_distance(first[..., i, :], second) for i in (0, 1)]
        + [_point_distance(second[..., i, :], first) for i in (0, 1)]
    )
    a, b = first[..., 1, :] - first[..., 0, :], second[..., 1, :] - second[..., 0, :]
    between = second[..., 0, :] - first[..., 0, :]
    normal = np.cross(a, b)
    square = (normal * normal).sum(axis=-1)
    crossing = square > 1e-12 * (a * a).sum(axis=-1) * (b * b).sum(axis=-1)
    square = np.where(crossing, square, 1.0)
    along_a = (np.cross(between, b) * normal).sum(axis=-1) / square
    along_b = (np.cross(between, a) * normal).sum(axis=-1) / square
    inside = (along_a > 0) & (along_a < 1) & (along_b > 0) & (along_b < 1)
    lines = np.abs((between * normal).sum(axis=-1)) / np.sqrt(square)
    return np.where(crossing & inside, np.minimum(lines, nearest), nearest)


def _point_distance(point: np.ndarray, segment: np.ndarray) -> np.ndarray:
    start, along = segment[..., 0, :], segment[..., 1, :] - segment[..., 0, :]
    square = np.maximum((along * along).sum(axis=-1), 1e-30)
    part = np.clip(((point - start) * along).sum(axis=-1) / square, 0.0, 1.0)
    return np.linalg.norm(point - start - part[..., None] * along, axis=-1)


def _at_most(name: str, unit: str, limit: float, values: np.ndarray) -> Finding:
    sizes = np.abs(values)
    beyond = int((sizes > limit * (1 + SLACK)).sum())
    return Finding(name, unit, limit, False, float(sizes.max()), beyond)


def _at_least(name: str, unit: str, limit: float, values: np.ndarray) -> Finding:
    slack = LENGTH_SLACK if unit == "m" else 0.0
    beyond = int((values < limit - slack).sum())
    return Finding(name, unit, limit, True, float(values.min()), beyond)
