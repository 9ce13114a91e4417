"""A user's own tetrahedral mesh: files, checks, and the mechanics of shapes that are no box."""

import meshio
import numpy as np
import pytest
from shapes import ball, cylinder, l_shape, shuffled
from small_block import SMALL, around

from codesign_sim import Block, Material, Simulator, SurfaceMesh, TetrahedralMesh
from codesign_sim.rest import rest_shape
from codesign_sim.tet_checks import quality

CUBE = Block((0.03, 0.03, 0.03), (3, 3, 3))


def weight_of(shape):
    return 1020 * shape.volume * 9.81


# ------------------------------------------------------------------------ mechanics


def test_a_shuffled_box_has_the_boxs_shape():
    mesh, order = shuffled(SMALL)
    assert np.allclose(mesh.nodes, SMALL.nodes[order], atol=1e-15)
    assert mesh.volume == pytest.approx(SMALL.volume)
    assert mesh.size == pytest.approx(SMALL.size)
    assert mesh.base_height == pytest.approx(0.02)
    assert mesh.surface_areas.sum() == pytest.approx(SMALL.surface_areas.sum())
    assert np.allclose(mesh.load_volumes, SMALL.load_volumes[order])


def test_cell_size_of_a_mesh_of_cubes_is_their_edge():
    assert shuffled(CUBE)[0].cell_size == pytest.approx(CUBE.cell_size) == pytest.approx(0.01)


def squeezed(shape, width=0.028):
    plates = SurfaceMesh.box((-0.04, 0.0, -0.04), (0.04, 0.01, 0.04))
    other = SurfaceMesh(plates.vertices * [1, -1, 1], plates.faces[:, ::-1])
    simulator = Simulator(shape, (plates, other), table_height=None, gravity=(0, 0, 0))
    simulator.reset(Material(friction=0.0))
    simulator.advance(0.01, around(width, height=shape.base_height))
    simulator.settle(0.5, 100.0)
    simulator.advance(0.001)
    return simulator


def test_frictionless_squeeze_equals_the_boxs():
    mesh, order = shuffled(SMALL)
    expected, measured = squeezed(SMALL), squeezed(mesh)
    force = expected.contact().left[0, 1]
    # E A gap / (length + 2 E / k): the block and two contact layers in series.
    assert force == pytest.approx(9e3 * 0.05 * 0.04 * 0.002 / (0.03 + 0.002), rel=1e-3)
    assert measured.contact().left[0, 1] == pytest.approx(force, rel=1e-4)
    # 2 um: what rounding leaves of a block that floats freely along x and z.
    assert np.allclose(measured.positions[0], expected.positions[0][order], atol=2e-6)
    for figure in ("top10_mean", "median", "mean"):
        both = (getattr(s.stress(), figure)[0] for s in (measured, expected))
        assert next(both) == pytest.approx(next(both), rel=1e-3)


@pytest.mark.parametrize("make", [cylinder, l_shape, lambda: ball(across=4)])
def test_a_resting_object_weighs_on_the_table_what_it_weighs(make):
    shape = make()
    simulator = Simulator(shape, table_height=0.1)
    simulator.reset(Material(), position=(0.3, -0.2), yaw=0.7)
    simulator.advance(0.05)
    table = simulator.contact().table[0]
    assert table == pytest.approx([0, 0, weight_of(shape)], abs=2e-3 * weight_of(shape))
    assert np.abs(simulator.velocities).max() < 1e-3
    centre, quaternion = simulator.object_pose()
    assert centre[0, :2] == pytest.approx([0.3, -0.2], abs=2e-4)
    assert shape.base_height - 0.004 < centre[0, 2] - 0.1 < shape.base_height
    assert 2 * np.arcsin(quaternion[0, 2]) == pytest.approx(0.7, abs=0.02)
    assert simulator.stress().von_mises.shape == (1, shape.resolution)


def test_an_undeformed_object_stands_where_it_is_put():
    shape = l_shape()
    simulator = Simulator(shape)
    simulator.reset(Material(), position=(0.1, 0.2), settle=False)
    now = simulator.positions[0]
    assert now[:, 2].min() == pytest.approx(0, abs=1e-8)
    centre = shape.load_volumes @ now / shape.volume
    assert centre[:2] == pytest.approx([0.1, 0.2], abs=1e-8)
    assert simulator.object_pose()[1][0] == pytest.approx([0, 0, 0, 1], abs=1e-6)


def test_pads_hold_a_cylinder(pads):
    shape = cylinder(radius=0.015, height=0.04, across=4, along=5)
    simulator = Simulator(shape, pads)
    simulator.reset(Material(friction=0.8), fingers=around(0.034))
    simulator.advance(0.2, around(0.024))
    simulator.advance(0.2, around(0.024, height=0.046))
    simulator.advance(0.4)
    contact = simulator.contact()
    assert contact.table[0, 2] == 0
    assert contact.left[0, 2] + contact.right[0, 2] == pytest.approx(weight_of(shape), rel=0.05)
    assert simulator.object_pose()[0][0, 2] > 0.035


def test_environments_and_single_agree_for_a_mesh(pads):
    shape = l_shape(cells=4)
    results = []
    for count in (1, 5):
        simulator = Simulator(shape, pads, count)
        simulator.reset(Material(), fingers=around(0.034, environments=count))
        simulator.advance(0.1, around(0.027, environments=count))
        results.append(simulator.positions)
    assert np.allclose(results[0][0], results[1][3], atol=2e-6)


def test_rest_shapes_of_a_mesh():
    shape = cylinder(across=4, along=4)
    rest = rest_shape(shape, Material())
    assert rest.shape == shape.nodes.shape
    assert -2e-3 < rest[:, 2].min() < 0


# ---------------------------------------------------------------------------- files


@pytest.mark.parametrize("suffix", [".msh", ".vtk", ".vtu", ".inp", ".mesh"])
def test_files_keep_the_mesh(tmp_path, suffix):
    path = tmp_path / f"object{suffix}"
    shape = cylinder()
    meshio.write(path, meshio.Mesh(1e3 * shape.nodes + 7, [("tetra", shape.tetrahedra)]))
    again = TetrahedralMesh.from_file(path, scale=1e-3)
    assert np.array_equal(again.tetrahedra, shape.tetrahedra)
    assert np.allclose(again.nodes, shape.nodes, atol=1e-8)


def written(tmp_path, cells, points=CUBE.nodes):
    path = tmp_path / "object.vtk"
    meshio.write(path, meshio.Mesh(points, cells))
    return path


def test_other_cells_are_ignored_and_told(tmp_path):
    halves = np.array_split(CUBE.tetrahedra, 2)
    cells = [
        ("triangle", CUBE.surface_triangles),
        *(("tetra", half) for half in halves),
        ("line", CUBE.surface_triangles[:5, :2]),
    ]
    with pytest.warns(UserWarning, match="ignored 108 triangle, 5 line beside"):
        mesh = TetrahedralMesh.from_file(written(tmp_path, cells))
    assert mesh.resolution == CUBE.resolution


def test_a_surface_alone_is_refused(tmp_path):
    path = written(tmp_path, [("triangle", CUBE.surface_triangles)])
    with pytest.raises(ValueError, match="has no tetrahedra, only 108 triangle; mesh its volume"):
        TetrahedralMesh.from_file(path)


@pytest.mark.parametrize("name", ["noise.msh", "noise.vtk", "noise.inp", "noise.xyz", "noise"])
def test_what_is_no_mesh_is_told(tmp_path, capsys, name):
    path = tmp_path / name
    path.write_bytes(bytes(range(256)) * 4)
    with pytest.raises(ValueError, match=r"cannot read .*noise.* as a mesh|has no tetrahedra"):
        TetrahedralMesh.from_file(path)
    assert capsys.readouterr().out == ""
    with pytest.raises(ValueError, match="no mesh file"):
        TetrahedralMesh.from_file(tmp_path / "missing.msh")


# --------------------------------------------------------------------------- checks


def refused(message, nodes=CUBE.nodes, tetrahedra=CUBE.tetrahedra):
    with pytest.raises(ValueError, match=message):
        TetrahedralMesh(nodes, tetrahedra)


def test_inverted_tetrahedra_are_named():
    tetrahedra = CUBE.tetrahedra.copy()
    tetrahedra[[3, 17]] = tetrahedra[[3, 17]][:, [0, 2, 1, 3]]
    refused(r"^2 tetrahedra are inverted \(index 3, 17\); swap two corners", tetrahedra=tetrahedra)
    mirrored = CUBE.tetrahedra[:, [0, 2, 1, 3]]
    refused(r"^135 .* inverted \(index 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, \.\.\.\)", tetrahedra=mirrored)


def test_degenerate_tetrahedra_are_named():
    nodes = CUBE.nodes.copy()
    tet = CUBE.tetrahedra[0]
    nodes[tet[0]] = nodes[tet[1:]].mean(axis=0) + 1e-7  # into the plane of the other three
    refused(r"tetrahedra are degenerate, of quality below 0.05: the worst is .*index 0", nodes)
    twice = CUBE.tetrahedra.copy()
    twice[5, 1] = twice[5, 0]
    refused(r"^1 tetrahedra are degenerate.*worst is 0 \(index 5\)", tetrahedra=twice)


def test_duplicate_nodes_are_named():
    corner = CUBE.tetrahedra[7, 2]
    tetrahedra = CUBE.tetrahedra.copy()
    tetrahedra[7, 2] = len(CUBE.nodes)
    nodes = np.vstack([CUBE.nodes, CUBE.nodes[corner]])
    refused(rf"^2 nodes lie on another node \(index {corner}, 64\); merge them", nodes, tetrahedra)


def test_unreferenced_nodes_are_named():
    nodes = np.vstack([CUBE.nodes, [[0, 0, 0.1]], [[0, 0, 0.2]]])
    refused(r"^2 nodes belong to no tetrahedron \(index 64, 65\); remove", nodes)


def test_several_pieces_are_named():
    nodes = np.vstack([CUBE.nodes, CUBE.nodes + np.array([0.05, 0, 0])])
    tetrahedra = np.vstack([CUBE.tetrahedra, CUBE.tetrahedra + 64])
    refused(r"2 pieces .* largest of 135 .*\(first of each: index 0, 135\)", nodes, tetrahedra)
    # Two cubes that touch along an edge only.
    touching = CUBE.nodes + np.array([0.03, 0.03, 0])
    first = np.flatnonzero(np.isclose(CUBE.nodes[:, :2], 0.015).all(axis=1))
    second = np.flatnonzero(np.isclose(CUBE.nodes[:, :2], -0.015).all(axis=1))
    kept = np.setdiff1d(np.arange(64), second)
    number = np.zeros(64, dtype=int)
    number[second], number[kept] = first, 64 + np.arange(60)
    nodes = np.vstack([CUBE.nodes, touching[kept]])
    refused(
        "2 pieces that share no face", nodes, np.vstack([CUBE.tetrahedra, number[CUBE.tetrahedra]])
    )


def test_a_surface_that_is_no_manifold_is_named():
    # Take two diagonally opposite columns of cells away: their common edge has four faces.
    cell = np.arange(CUBE.resolution) // 5
    i, j = cell % 3, cell // 3 % 3
    kept = CUBE.tetrahedra[~(((i == 0) & (j == 0)) | ((i == 1) & (j == 1)))]
    used, tetrahedra = np.unique(kept, return_inverse=True)
    message = r"^4 nodes lie on surface edges with more than two triangles.*index \d+"
    refused(message, CUBE.nodes[used], tetrahedra.reshape(-1, 4))


def test_overlapping_tetrahedra_are_named():
    tetrahedra = np.vstack([CUBE.tetrahedra, CUBE.tetrahedra[4:5]])
    refused("tetrahedra share a face with two others .*135", tetrahedra=tetrahedra)


def test_a_size_that_cannot_be_in_metres_is_named():
    refused(
        r"mesh measures 30 x 30 x 30 m; .* millimetres, load it with scale 0.001", 1e3 * CUBE.nodes
    )
    refused(r"mesh measures 3e-05 x 3e-05 x 3e-05 m.* scale 1000", 1e-3 * CUBE.nodes)


def test_numbers_and_indices_are_checked():
    nodes = CUBE.nodes.copy()
    nodes[[5, 9], 1] = np.nan
    refused(r"^2 nodes are not finite \(index 5, 9\)", nodes)
    refused(r"name nodes beyond the 63 there are", CUBE.nodes[:63])
    refused(r"name nodes beyond the 64", tetrahedra=CUBE.tetrahedra - 1)
    refused(r"must be integers of shape \(T, 4\)", tetrahedra=CUBE.tetrahedra[:, :3])
    refused(r"must be integers of shape \(T, 4\)", tetrahedra=CUBE.tetrahedra * 1.0)
    refused(r"nodes have shape \(64, 2\)", CUBE.nodes[:, :2])
    refused("mesh has no tetrahedra", tetrahedra=CUBE.tetrahedra[:0])


def test_quality_of_known_tetrahedra():
    regular = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) * 1.0
    corner = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) * 1.0
    order = np.array([[0, 1, 2, 3]])
    assert quality(corner, order)[0] == pytest.approx(12 * 0.5 ** (2 / 3) / 9)
    assert abs(quality(regular, order)[0]) == pytest.approx(1)
    assert quality(corner, order[:, [1, 0, 2, 3]])[0] == pytest.approx(-12 * 0.5 ** (2 / 3) / 9)
