"""The gap at which fingers first touch, against shapes with known answers."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from small_block import SMALL, around

from codesign_sim import Material, Simulator, SurfaceMesh, closing, closing_limit, disk_cache


def joined(*boxes):
    """The union of boxes as one surface."""
    solid = trimesh.boolean.union(
        [trimesh.creation.box(bounds=np.array(b)) for b in boxes], engine="manifold"
    )
    return SurfaceMesh(solid.vertices, solid.faces)


def mirrored(mesh):
    return SurfaceMesh(mesh.vertices * [1, -1, 1], mesh.faces[:, ::-1])


def scoop(lip, thickness=0.003, low=-0.01, high=0.01):
    """A pad with a lip at its tip that reaches `lip` metres beyond its face."""
    return joined(
        [(-0.01, 0.0, -0.025), (0.01, 0.01, 0.025)],
        [(low, -lip, 0.025 - thickness), (high, 0.01, 0.025)],
    )


def test_flat_pads_close_to_nothing(pads):
    assert closing_limit(*pads) == 0.0


def test_pads_set_back_close_to_nothing():
    left = SurfaceMesh.box((-0.01, 0.002, -0.025), (0.01, 0.01, 0.025))
    assert closing_limit(left, mirrored(left)) == 0.0


@pytest.mark.parametrize("lip", [0.001, 0.0073, 0.012])
def test_lips_stop_where_they_meet(lip):
    left = scoop(lip)
    assert closing_limit(left, mirrored(left)) == pytest.approx(2 * lip, abs=2e-6)


def test_a_lip_against_a_flat_pad(pads):
    assert closing_limit(scoop(0.006), pads[1]) == pytest.approx(0.006, abs=2e-6)
    assert closing_limit(pads[0], mirrored(scoop(0.006))) == pytest.approx(0.006, abs=2e-6)


def test_lips_side_by_side_pass_each_other():
    left = scoop(0.006, low=-0.01, high=-0.001)
    right = mirrored(scoop(0.008, low=0.001, high=0.01))
    # Each stops at the other's pad, the longer one first.
    assert closing_limit(left, right) == pytest.approx(0.008, abs=2e-6)


def test_fingers_beside_each_other_never_touch():
    left = SurfaceMesh.box((0.001, -0.005, -0.02), (0.02, 0.01, 0.02))
    right = SurfaceMesh.box((-0.02, -0.01, -0.02), (-0.001, 0.005, 0.02))
    assert closing_limit(left, right) == 0.0


def test_crossed_ridges():
    # One edge along x, one along z: only edges meet, no corner is near.
    ridge = trimesh.creation.cylinder(radius=0.004, height=0.04, sections=3)
    along_z = ridge.vertices @ Rotation.from_euler("z", np.pi).as_matrix().T
    turned = ridge.vertices @ Rotation.from_euler("y", np.pi / 2).as_matrix().T
    left = SurfaceMesh(along_z, ridge.faces)
    right = SurfaceMesh(turned, ridge.faces)
    expected = right.vertices[:, 1].max() - left.vertices[:, 1].min()
    assert closing_limit(left, right) == pytest.approx(expected, abs=4.5e-4)  # 0.25 mm * slope


@settings(max_examples=15, deadline=None)
@given(st.floats(0.003, 0.01), st.floats(0.003, 0.01), st.floats(-0.006, 0.006))
def test_spheres(first, second, aside):
    centre = np.array([aside, 0.0, 0.0])
    ball = trimesh.creation.icosphere(subdivisions=3)
    left = SurfaceMesh(ball.vertices * first, ball.faces)
    right = SurfaceMesh(ball.vertices * second + centre, ball.faces)
    reach = first + second
    # Facets lie up to 0.7 % of the radius inside.
    least, most = (np.sqrt(max(r**2 - aside**2, 0)) for r in (0.993 * reach, reach))
    assert least - 2e-6 <= closing_limit(left, right) <= most + 2e-6


def test_the_limit_is_kept_on_disk(tmp_path, monkeypatch):
    monkeypatch.setattr(disk_cache, "cache_folder", lambda: tmp_path)
    left = scoop(0.0051)
    limit = closing_limit(left, mirrored(left))
    closing._limit_cached.cache_clear()
    monkeypatch.setattr(closing, "_largest_overlap", None)  # must not be needed
    assert closing_limit(left, mirrored(left)) == limit


def test_targets_are_held_to_the_limit(pads):
    left = scoop(0.006)
    simulator = Simulator(SMALL, [pads, (left, mirrored(left))], 2)
    assert simulator.closing_limits == pytest.approx([0, 0.012], abs=2e-6)
    simulator.reset(Material(), position=(0.3, 0.0), fingers=around(0.03, environments=2))
    simulator.advance(0.2, around(0.0, environments=2))
    assert simulator.fingers.width == pytest.approx([0, 0.012], abs=2e-6)
    simulator.set_fingers(*pads, environments=[1])
    assert (simulator.closing_limits == 0).all()
    simulator.set_fingers(scoop(0.007), pads[1], environments=[0])
    assert simulator.fingers.width == pytest.approx([0.007, 0.012], abs=2e-6)


def crossing_pair():
    left = scoop(0.012)
    return left, mirrored(left)


def centre_speed(simulator):
    weights = SMALL.node_volumes / SMALL.volume
    return np.linalg.norm(np.einsum("n,enk->ek", weights, simulator.velocities), axis=1)


@pytest.mark.parametrize("height", [0.026, 0.04])
def test_crossing_ledges_squeeze_without_ejecting(height):
    simulator = Simulator(SMALL, crossing_pair())
    simulator.reset(Material(), fingers=around(0.06, height=height))
    speed, depth = [], []
    for width in np.linspace(0.055, 0.0, 12):
        simulator.advance(0.05, around(float(width), height=height))
        speed.append(centre_speed(simulator)[0])
        depth.append(simulator.contact().finger_penetration[0])
    assert max(speed) < 0.1
    # Ledges that pass through each other reach 3 mm deep, through the whole lip.
    assert max(depth) < 1.2e-3


def test_violent_actions_with_crossing_ledges_stay_slow():
    count = 8
    simulator = Simulator(SMALL, crossing_pair(), count)
    rng = np.random.default_rng(2)
    place, width = np.tile([0.0, 0.0, 0.03], (count, 1)), np.full(count, 0.05)
    simulator.reset(Material(), fingers=around(0.05, height=0.03, environments=count))
    fastest = 0.0
    for _ in range(40):
        place = np.clip(
            place + rng.uniform(-0.02, 0.02, place.shape), [-0.03, -0.03, 0.015], [0.03, 0.03, 0.08]
        )
        width = np.clip(width + rng.uniform(-0.03, 0.03, count), 0.0, 0.06)
        targets = around(0.05, environments=count)
        targets = type(targets)(place, targets.quaternion, width)
        simulator.advance(0.05, targets)
        fastest = max(fastest, centre_speed(simulator).max())
    assert fastest < 5.0
