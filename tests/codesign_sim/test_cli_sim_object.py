"""`codesign sim object`."""

import json

import meshio
import numpy as np
import pytest
from shapes import cylinder
from typer.testing import CliRunner

from codesign_cli.sim import app
from codesign_sim import Block, Simulator

BOX = Block((0.05, 0.03, 0.04), (5, 3, 4))


@pytest.fixture
def written(tmp_path):
    def write(nodes=1e3 * BOX.nodes, tetrahedra=BOX.tetrahedra, more=()):
        path = tmp_path / "object.vtk"
        meshio.write(path, meshio.Mesh(nodes, [("tetra", tetrahedra), *more]))
        return str(path)

    return write


def invoke(*arguments):
    return CliRunner().invoke(app, ["object", *arguments])


def test_figures_of_a_box(written):
    result = invoke(
        written(more=[("triangle", BOX.surface_triangles)]), "--scale", "1e-3", "--json"
    )
    assert result.exit_code == 0
    report = json.loads(result.stdout)
    assert report["sound"] is True
    assert (report["tetrahedra"], report["nodes"]) == (300, 120)
    assert report["surface_triangles"] == 2 * 2 * (5 * 3 + 3 * 4 + 5 * 4)
    assert report["size"] == pytest.approx([0.05, 0.03, 0.04])
    assert report["volume"] == pytest.approx(6e-5)
    assert report["mass"] == pytest.approx(0.0612)
    assert report["worst_quality"] == pytest.approx(12 * 0.5 ** (2 / 3) / 9)
    assert report["volume_ratio"] == pytest.approx(2)
    assert report["contact_spacing"] == pytest.approx(0.01 / np.sqrt(2))
    assert "ignored 188 triangle" in report["notes"][0]


def test_the_time_step_is_the_simulators(written):
    shape = cylinder(across=4, along=4)
    path = written(shape.nodes, shape.tetrahedra)
    simulator = Simulator(shape)
    simulator.reset()
    report = json.loads(invoke(path, "--json").stdout)
    assert report["time_step"] == pytest.approx(simulator.time_step, rel=1e-6)


def test_a_table_for_people(written):
    result = invoke(written(), "--scale", "0.001")
    assert result.exit_code == 0
    assert "50.0 x 30.0 x 40.0" in result.stdout
    assert "61.20" in result.stdout


def test_a_mesh_in_millimetres_fails_with_the_remedy(written):
    path = written()
    result = invoke(path)
    assert result.exit_code == 1
    assert "50 x 30 x 40 m" in result.stderr
    assert "scale 0.001" in result.stderr
    result = invoke(path, "--json")
    assert result.exit_code == 1
    assert json.loads(result.stdout)["sound"] is False


def test_bad_elements_fail_with_their_indices(written):
    tetrahedra = BOX.tetrahedra.copy()
    tetrahedra[7] = tetrahedra[7][[1, 0, 2, 3]]
    result = invoke(written(tetrahedra=tetrahedra), "--scale", "1e-3")
    assert result.exit_code == 1
    assert "1 tetrahedra are inverted (index 7)" in result.stderr


def test_missing_files_and_wrong_scales(tmp_path, written):
    assert invoke(str(tmp_path / "none.msh")).exit_code == 2
    result = invoke(written(), "--scale", "-1")
    assert result.exit_code == 1
    assert "scale is -1; it must be above 0" in result.stderr
