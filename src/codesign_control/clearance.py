"""Distances of the arm to itself and to the table, fast enough for every tick (coal)."""

from __future__ import annotations

import math

import coal
import numpy as np
import pinocchio as pin

from codesign_control.capsules import (
    ARM,
    arm_capsules,
    hand_capsules,
    placed,
    watched_pairs,
)
from codesign_control.config import ServoConfig
from codesign_control.gripper import CRANK, CRANK_ANGLE
from codesign_control.hand import TCP_FROM_FLANGE, Hand
from codesign_control.xarm7 import urdf

OVER_TABLE = ARM[2:]  # the base and link 1 keep their height; `HandHeight` sees to the hand
# m/rad: no point of the arm or hand moves faster when a joint turns. The reach from each joint's
# axis with everything stretched, and a hand of 0.35 m.
REACH = np.array([1.3, 1.3, 1.1, 1.1, 0.6, 0.6, 0.4])
GRIPPER = ("link7", "gripper_base_link")
WIDTH_STEP = 0.004  # m, of the gaps that stand for all those between
# 1/m: between two gaps s [m] apart the four-bar's arc leaves its chord by at most BULGE * s * s,
# 16 um for 4 mm: arc^2 / (8 radius), and a finger's arc is at most s / 2 / sin(its open angle).
BULGE = 1.0 / (32.0 * math.sin(CRANK_ANGLE) ** 2 * CRANK)


class Clearance:
    """Pairs of capsules that must stay apart, and links that must stay above the table.

    Distances are exact and negative where capsules overlap. One object holds scratch memory and
    serves one thread.
    """

    def __init__(self, config: ServoConfig, hand: Hand) -> None:
        self._model = pin.buildModelFromXML(urdf())
        self._data = self._model.createData()
        self._geometry = pin.GeometryModel()
        capsules = arm_capsules() + hand_capsules(hand)
        for index, capsule in enumerate(capsules):
            link, start, end = placed(capsule)
            frame = self._model.frames[self._model.getFrameId(link)]
            placement = frame.placement * pin.SE3(_z_along(end - start), (start + end) / 2.0)
            shape = coal.Capsule(capsule.radius, float(np.linalg.norm(end - start)))
            self._geometry.addGeometryObject(
                pin.GeometryObject(f"{capsule.link} {index}", frame.parentJoint, placement, shape)
            )
        ground = coal.Halfspace(np.array([0.0, 0.0, 1.0]), config.table_height)
        table = self._geometry.addGeometryObject(
            pin.GeometryObject("table", 0, pin.SE3.Identity(), ground)
        )
        pairs = watched_pairs(capsules)
        over = [(i, table) for i, c in enumerate(capsules) if c.link in OVER_TABLE]
        for pair in pairs + over:
            self._geometry.addCollisionPair(pin.CollisionPair(*pair))
        links = [capsule.link for capsule in capsules] + ["table"]
        # What every entry of `room` is about: two links, or a link and "table".
        self.names = [(links[i], links[j]) for i, j in pairs + over]
        self.self_pairs = len(pairs)  # these come first
        bodies = [capsule.body for capsule in capsules] + [0]
        joints = np.arange(1, 8)
        # (P, 7): 1 where a joint moves the second of a pair against the first, -1 the other way.
        self._moves = np.array(
            [
                1.0 * ((joints > bodies[i]) & (joints <= bodies[j]))
                - 1.0 * ((joints > bodies[j]) & (joints <= bodies[i]))
                for i, j in pairs + over
            ]
        )
        self._margin = np.full(len(self.names), config.self_collision_margin)
        self._margin[self.self_pairs :] = config.table_margin
        self._reach = (REACH * np.abs(self._moves)).T
        self._queries = self._geometry.createData()
        for request, margin in zip(self._queries.collisionRequests, self._margin, strict=True):
            request.security_margin = float(margin)
        self._results = list(self._queries.distanceResults)

    def room(self, q: np.ndarray) -> np.ndarray:
        """(P,) m: what every pair's distance is above its margin at joints (7,) rad."""
        pin.computeDistances(self._model, self._data, self._geometry, self._queries, q)
        return np.array([result.min_distance for result in self._results]) - self._margin

    def fastest(self, turned: np.ndarray) -> np.ndarray:
        """(..., P) m: no pair's distance changes by more when the joints turn by (..., 7) rad."""
        return np.abs(turned) @ self._reach

    def clear(self, q: np.ndarray) -> bool:
        """Whether every pair keeps its margin at joints (7,) rad; cheaper than `room`."""
        return not pin.computeCollisions(
            self._model, self._data, self._geometry, self._queries, q, True
        )

    def gradient(self, q: np.ndarray, pairs: np.ndarray) -> np.ndarray:
        """(K, 7) m/rad: how some pairs' distances change with each joint at (7,) rad."""
        pin.computeDistances(self._model, self._data, self._geometry, self._queries, q)
        results = [self._results[pair] for pair in pairs]
        moves = self._moves[pairs]
        # The nearest point of whichever of the two is moved.
        second = moves.sum(axis=1) > 0.0
        points = np.array(
            [
                r.getNearestPoint2() if is_second else r.getNearestPoint1()
                for r, is_second in zip(results, second, strict=True)
            ]
        )
        normals = np.array([r.normal for r in results])  # from the first to the second
        placements = [self._data.oMi[joint] for joint in range(1, 8)]
        origins = np.array([placement.translation for placement in placements])
        axes = np.array([placement.rotation[:, 2] for placement in placements])
        # normal . (axis x (point - origin)), for all pairs and joints at once
        turned = _cross(points, normals) @ axes.T - normals @ _cross(axes, origins).T
        return np.asarray(moves * turned)

    def describe(self, room: np.ndarray) -> str:
        """The pair with the least room and its distance, as text."""
        tightest = int(room.argmin())
        first, second = self.names[tightest]
        distance, margin = room[tightest] + self._margin[tightest], self._margin[tightest]
        return f"{first} and {second} {1e3 * distance:.1f} mm apart, at least {1e3 * margin:.1f} mm"


class HandHeight:
    """How far the hand is above the table: fingers to their very corners, the gripper as capsules.

    Room is the height above the table that is left: for fingers down to the table itself, for the
    gripper's capsules down to the margin of the arm's links.
    """

    def __init__(self, config: ServoConfig, hand: Hand) -> None:
        self._hand = hand
        self._table = config.table_height
        capsules = [c for c in arm_capsules() + hand_capsules(hand) if c.link in GRIPPER]
        # Both links lie on the flange; `link_tcp` is a fixed way further along its z.
        ends = np.array([end for c in capsules for end in (c.start, c.end)])
        self._gripper = ends - [0.0, 0.0, TCP_FROM_FLANGE]
        self._gripper_needs = np.repeat([c.radius + config.table_margin for c in capsules], 2)
        self._widths = (0.0, 0.0)
        self.set_widths(hand.width_range)

    @property
    def widths(self) -> tuple[float, float]:
        """Between these two gaps [m] the fingers may be."""
        return self._widths

    def set_widths(self, widths: tuple[float, float]) -> None:
        """From here on the fingers may be anywhere between two gaps [m]."""
        if widths != self._widths:
            self._widths = widths
            self._points, self._needs = self._surface(widths)

    def rooms(self, tcp: pin.SE3) -> tuple[np.ndarray, np.ndarray]:
        """(N,) m: room below every point of the hand; (N, 3) m: the points, from `link_tcp` on."""
        offsets = self._points @ tcp.rotation.T
        return tcp.translation[2] - self._table + offsets[:, 2] - self._needs, offsets

    def least(self, path: np.ndarray, widths: tuple[float, float] | None = None) -> np.ndarray:
        """(n,) m: least room of the hand along (n, 4, 4) placements of `link_tcp`.

        widths: other gaps than those set [m].
        """
        points, needs = self._surface(widths) if widths else (self._points, self._needs)
        rooms = path[:, 2, :3] @ points.T - needs
        return np.asarray(rooms.min(axis=1) + path[:, 2, 3] - self._table)

    def _surface(self, widths: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
        """(N, 3) m: lowest candidates in `link_tcp`; (N,) m: the height that each one needs."""
        low, high = sorted(self._hand.gripper.clip(width) for width in widths)
        steps = 1 if high - low < 1e-6 else 2 + int((high - low) / WIDTH_STEP)
        corners = [self._hand.corners(width) for width in np.linspace(low, high, steps)]
        bulge = BULGE * ((high - low) / max(1, steps - 1)) ** 2
        needs = np.concatenate([np.full(sum(map(len, corners)), bulge), self._gripper_needs])
        return np.concatenate([*corners, self._gripper]), needs


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products of (n, 3) and (n, 3); several times as fast as numpy's."""
    return a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]]


def _z_along(direction: np.ndarray) -> np.ndarray:
    """A rotation whose z axis points along `direction`."""
    length = float(np.linalg.norm(direction))
    if length < 1e-12:
        return np.eye(3)
    z = np.array([0.0, 0.0, 1.0])
    return np.asarray(pin.Quaternion.FromTwoVectors(z, direction / length).toRotationMatrix())
