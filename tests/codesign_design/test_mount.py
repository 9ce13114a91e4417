"""The mount, measured on finished meshes, and the gripper's numbers."""

import numpy as np
import pytest
import trimesh

from codesign_control.gripper import GripperModel
from codesign_design.build import build_finger
from codesign_design.columns import Columns, crossings
from codesign_design.experts import expert_surface
from codesign_design.finger_pair import FingerPair, TriangleMesh
from codesign_design.gripper_check import check_gripper
from codesign_design.gripper_geometry import drive_joint_at, gap, link_origin
from codesign_design.mount import MAX_DEPTH, mount_finger
from codesign_design.mount_check import check_mount
from codesign_design.stock import LINK_Z, stock_fingers

FLAT = expert_surface("flat_pad")


def ball(radius: float, centre: tuple[float, float, float]) -> TriangleMesh:
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return TriangleMesh(np.array(sphere.vertices) + centre, sphere.faces.astype(np.int32))


@pytest.fixture(scope="module")
def finger() -> TriangleMesh:
    return mount_finger(FLAT).mesh


def test_mount_has_the_stock_fingers_dimensions(finger: TriangleMesh) -> None:
    measured = check_mount(finger)
    assert not measured.problems
    assert measured.face_share == 1.0
    assert measured.hole_diameters == pytest.approx((3.2, 3.2), abs=0.05)
    assert measured.channel_diameters == pytest.approx((5.5, 5.5), abs=0.05)
    assert measured.webs == pytest.approx((2.5, 2.5), abs=1e-3)


@pytest.mark.parametrize("hole", [31.0, 43.0])  # mm, z in the finger link
def test_hole_centres_are_where_the_link_has_them(finger: TriangleMesh, hole: float) -> None:
    reach = np.arange(-0.0025, 0.0025, 5e-5) + 1.7e-5
    columns = Columns(1, hole * 1e-3 + LINK_Z + reach, reach)
    free = np.ones(columns.count, dtype=bool)
    free[crossings(finger, columns).column] = False
    z, x = np.meshgrid(reach, reach, indexing="ij")
    assert z.ravel()[free].mean() == pytest.approx(0.0, abs=3e-5)
    assert x.ravel()[free].mean() == pytest.approx(0.0, abs=3e-5)


def test_a_finger_without_holes_is_found_out() -> None:
    measured = check_mount(stock_fingers().left)
    assert max(measured.hole_diameters) == 0.0
    assert any("screw hole" in problem for problem in measured.problems)


def test_a_body_beside_the_boss_is_bridged() -> None:
    built = build_finger(ball(0.006, (0.030, 0.0, 0.010)))
    assert mount_finger(ball(0.006, (0.030, 0.006, 0.010))).bridged
    assert built.report.mesh.valid
    assert not check_mount(built.pair.left).problems


def test_deep_body_is_cut_at_the_mount_face() -> None:
    built = build_finger(ball(0.024, (0.0, 0.0, -0.0175)))
    depth = built.pair.left.vertices[:, 1].max()
    assert depth == pytest.approx(MAX_DEPTH, abs=1e-3)
    assert built.report.deviation.cut == pytest.approx(0.048 - depth, abs=1e-3)


@pytest.mark.parametrize(
    ("q", "expected"), [(0.0, 88.93), (0.2, 70.81), (0.4, 50.59), (0.6, 29.07), (0.85, 1.65)]
)
def test_pad_gap_over_the_drive(q: float, expected: float) -> None:
    assert gap(q, 0.026) * 1e3 == pytest.approx(expected, abs=0.006)
    assert drive_joint_at(gap(q, 0.026), 0.026) == pytest.approx(q, abs=1e-9)


def test_four_bar_equals_the_controllers() -> None:
    for q in np.linspace(0.0, 0.85, 9):
        assert link_origin(q) == pytest.approx(GripperModel.finger_position(q), abs=1e-12)
    rise = link_origin(0.85)[1] - link_origin(0.0)[1]
    assert rise * 1e3 == pytest.approx(12.35, abs=0.005)


@pytest.mark.parametrize("depth", [0.007, 0.0078, 0.012, 0.020])
def test_limits_agree_with_the_controllers(depth: float) -> None:
    slab = trimesh.creation.box((0.02, depth, 0.04))
    slab.apply_translation((0.0, depth / 2, -0.0215))
    left = TriangleMesh(np.array(slab.vertices), slab.faces.astype(np.int32))
    pair = FingerPair("slab", left, left.mirrored_y(), 0.0, 0.1)
    check, model = check_gripper(left), GripperModel(pair.protrusion)
    assert check.min_width == pytest.approx(model.min_width, abs=1e-9)
    assert check.max_width <= model.max_width
    if check.contact_drive_joint is None:
        assert model.min_width > 0
    else:
        assert check.contact_drive_joint == pytest.approx(model.drive_joint(0.0), abs=1e-9)


def test_contact_angle_of_a_tilted_face() -> None:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (0, 1) for z in (-1, 1)], dtype=float)
    corners[:, 1] += np.where(corners[:, 1] == 0, 0.01 * (corners[:, 2] + 1), 0)
    hull = trimesh.convex.convex_hull(corners * 0.01)
    check = check_gripper(TriangleMesh(np.array(hull.vertices), hull.faces.astype(np.int32)))
    assert check.contact_angle == pytest.approx(np.arctan(0.01), abs=1e-6)


def test_collisions_are_reported_with_their_depth() -> None:
    low = trimesh.creation.box((0.02, 0.01, 0.08))
    low.apply_translation((0.0, 0.005, -0.05))
    check = check_gripper(TriangleMesh(np.array(low.vertices), low.faces.astype(np.int32)))
    lowest = -0.09 + 0.172 - 0.012350  # base frame, open
    assert check.palm_clearance == pytest.approx(lowest - 0.099, abs=1e-5)
    assert len([p for p in check.problems if "collides" in p]) == 2
