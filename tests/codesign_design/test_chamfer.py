"""Chamfer distance and volume overlap against shapes whose answer is known."""

import numpy as np
import pytest
import trimesh

from codesign_design.chamfer import chamfer_distance, distances_to, volume_iou
from codesign_design.finger_pair import TriangleMesh


def box(size: tuple[float, float, float], shift: float = 0.0) -> TriangleMesh:
    """A cuboid in millimetres, moved along x."""
    mesh = trimesh.creation.box(np.array(size) * 1e-3)
    return TriangleMesh(mesh.vertices + np.array([shift * 1e-3, 0, 0]), mesh.faces.astype(np.int32))


def ball(radius: float) -> TriangleMesh:
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius * 1e-3)
    return TriangleMesh(np.array(mesh.vertices), mesh.faces.astype(np.int32))


def test_a_surface_is_at_no_distance_from_itself() -> None:
    assert chamfer_distance(ball(20), ball(20), samples=500) < 1e-9


@pytest.mark.parametrize("gap", [0.5, 2.0])
def test_concentric_balls_are_apart_by_the_difference_of_their_radii(gap: float) -> None:
    distance = chamfer_distance(ball(20.0), ball(20.0 + gap), samples=2000)
    # Facets of an icosphere lie up to 0.1 % of the radius inside: 0.02 mm.
    assert distance * 1e3 == pytest.approx(gap, abs=0.03)


def test_both_directions_count_equally() -> None:
    # A thin rod inside a long one of the same section: nothing of the short rod is away from the
    # long one's surface but its two ends (their centre 1 mm from the sides), while the long rod's
    # surplus at x in [5, 15] mm is 5 mm away on average.
    short, long = box((10, 2, 2)), box((30, 2, 2))
    there = distances_to(short.vertices, long)
    np.testing.assert_allclose(there, 0.0, atol=1e-12)
    distance = chamfer_distance(short, long, samples=40_000) * 1e3
    sides, ends = 30 * 2 * 4, 2 * 4
    back = (2 / 3 * sides * 5 + ends * 10) / (sides + ends)
    # The short rod's ends: the distance to the nearest side of a 2 x 2 square is 1/3 on average.
    to = 8 / (10 * 2 * 4 + 8) / 3
    assert distance == pytest.approx((back + to) / 2, rel=0.01)


def test_is_symmetric_and_repeatable() -> None:
    a, b = ball(10), box((20, 15, 12))
    assert chamfer_distance(a, b) == pytest.approx(chamfer_distance(b, a), rel=0.02)
    assert chamfer_distance(a, b) == chamfer_distance(a, b)


def test_overlap_of_shifted_boxes_is_known() -> None:
    a, b = box((20, 20, 20)), box((20, 20, 20), shift=10.0)
    assert volume_iou(a, a, spacing=1e-3) == 1.0
    assert volume_iou(a, b, spacing=1e-3) == pytest.approx(1 / 3, abs=0.02)


def test_overlap_within_a_region_ignores_the_rest() -> None:
    a, b = box((20, 20, 20)), box((40, 20, 20), shift=10.0)
    left = np.array([[-0.01, -0.02, -0.02], [0.01, 0.02, 0.02]])
    right = np.array([[0.0, -0.02, -0.02], [0.02, 0.02, 0.02]])
    assert volume_iou(a, b, 1e-3, left) == 1.0
    assert volume_iou(a, b, 1e-3, right) == pytest.approx(0.5, abs=0.03)
    with pytest.raises(ValueError, match="neither body reaches into the region"):
        volume_iou(a, a, 1e-3, left + np.array([0.1, 0, 0]))


def test_a_fold_counts_once() -> None:
    one = ball(10)
    twice = TriangleMesh(
        np.concatenate([one.vertices, one.vertices * 0.9]),
        np.concatenate([one.faces, one.faces + len(one.vertices)]),
    )
    assert volume_iou(one, twice, spacing=1e-3) == 1.0
