"""Base meshes and the cages around them."""

import igl
import numpy as np
import pytest
import trimesh

from codesign_design import base_mesh as meshes
from codesign_design.base_mesh import base_mesh, base_mesh_names
from codesign_design.cage import cage_names, load_cage

MM = 24.0  # mm per unit


def as_trimesh(vertices: np.ndarray, faces: np.ndarray) -> trimesh.Trimesh:
    return trimesh.Trimesh(vertices, faces, process=False)


@pytest.mark.parametrize("name", base_mesh_names())
def test_base_mesh_is_one_closed_well_shaped_surface(name: str) -> None:
    base = base_mesh(name)
    mesh = as_trimesh(base.vertices, base.faces)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.body_count == 1
    assert mesh.volume > 0
    assert mesh.euler_number == (0 if name == "torus" else 2)
    assert 2000 <= len(base.vertices) <= 5000
    squares = (np.diff(mesh.triangles[:, [0, 1, 2, 0]], axis=1) ** 2).sum((1, 2))
    quality = 4 * np.sqrt(3) * mesh.area_faces / squares  # 1 for equilateral triangles
    assert np.median(quality) > 0.75
    assert quality.min() > 0.1


@pytest.mark.parametrize(
    ("name", "volume"),
    [
        ("sphere", 4 / 3 * np.pi),
        ("torus", 2 * np.pi**2 * 0.7 * 0.3**2),
        ("box", 32.0 * 14.0 * 48.0 / MM**3),
    ],
)
def test_base_mesh_has_the_volume_of_its_shape(name: str, volume: float) -> None:
    base = base_mesh(name)
    # Chords instead of arcs and fillets of the box take off up to 1.5 %.
    assert as_trimesh(base.vertices, base.faces).volume == pytest.approx(volume, rel=0.015)


@pytest.mark.parametrize(("name", "profile"), [("lip", meshes.LIP), ("wide", meshes.WIDE)])
def test_lip_is_as_thin_and_long_as_it_says(name: str, profile: meshes.LProfile) -> None:
    base = base_mesh(name)
    points = base.vertices * MM
    depth = np.ptp(points[:, 1])
    assert depth == pytest.approx(profile.depth + profile.lip, abs=1e-9)
    assert np.ptp(points[:, 0]) == pytest.approx(profile.width, abs=1e-9)
    front = points[:, 1].min()
    half_way = (profile.thickness + profile.tip) / 2
    for ahead, thickness in ((9.0, profile.thickness), (profile.chamfer / 2, half_way)):
        probe = np.array([[0.0, front + ahead, z] for z in np.arange(-24.0, 24.0, 0.01)])
        inside = igl.fast_winding_number(base.vertices, base.faces.astype(np.int64), probe / MM)
        # 9 mm behind the tip the fillet to the body begins: 0.1 mm.
        assert (inside > 0.5).sum() * 0.01 == pytest.approx(thickness, abs=0.15)
        assert probe[inside > 0.5][:, 2].min() > 22.0  # at the lower end


@pytest.mark.parametrize("name", cage_names())
def test_cage_is_closed_and_contains_its_base_mesh(name: str) -> None:
    cage, base = load_cage(name), base_mesh(name.split("-")[0])
    mesh = as_trimesh(cage.handles, cage.faces)
    assert len(cage.handles) == int(name.split("-")[1])
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    faces = cage.faces.astype(np.int64)
    inside = igl.winding_number(cage.handles, faces, base.vertices)
    assert inside.min() > 0.99
    squared, _, _ = igl.point_mesh_squared_distance(base.vertices, cage.handles, faces)
    assert np.sqrt(squared.min()) > 0.005  # strictly inside


def test_every_base_mesh_has_three_cages() -> None:
    assert set(cage_names()) == {f"{b}-{n}" for b in base_mesh_names() for n in (7, 12, 30)}


def test_torus_cages_of_many_handles_have_a_hole_of_their_own() -> None:
    for name in ("torus-12", "torus-30"):
        cage = load_cage(name)
        assert as_trimesh(cage.handles, cage.faces).euler_number == 0


def test_unknown_names_are_refused_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"'cube'; choose from box, lip, sphere, torus, wide"):
        base_mesh("cube")
    with pytest.raises(ValueError, match=r"'sphere-8'; choose from .*sphere-7"):
        load_cage("sphere-8")
