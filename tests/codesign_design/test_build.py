"""Build, report, files: every finger is valid or says why; files hold the same finger."""

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from codesign_cli.main import app
from codesign_design.batch import RandomDesign, build_random
from codesign_design.build import BuiltFinger, build_finger
from codesign_design.design_file import write_parameters
from codesign_design.design_space import design_space
from codesign_design.experts import expert_surface
from codesign_design.finger_files import load_finger_pair, save_finger_pair
from codesign_design.finger_pair import TriangleMesh
from codesign_design.printability import check_printing
from codesign_sim.mesh import SurfaceMesh


@pytest.fixture(scope="module")
def flat() -> BuiltFinger:
    return build_finger(expert_surface("flat_pad"), "flat")


@pytest.fixture(scope="module")
def folder(flat: BuiltFinger, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("finger")
    save_finger_pair(path, flat)
    return path


@pytest.mark.parametrize("name", ["flat_pad", "cupped_pad", "scoop"])
def test_experts_are_kept_sharp_and_valid(name: str) -> None:
    raw = expert_surface(name)
    built = build_finger(raw, name)
    assert built.report.valid, built.report.problems
    assert not built.report.deviation.remeshed
    assert built.pair.left.vertices[:, 1].max() == pytest.approx(raw.vertices[:, 1].max(), abs=1e-6)
    for mesh in (built.pair.left, built.pair.right):
        assert SurfaceMesh(mesh.vertices, mesh.faces).radius > 0


@pytest.mark.parametrize("index", range(3))
@pytest.mark.parametrize("space", ["sphere-7", "sphere-30"])
def test_random_designs_are_valid(space: str, index: int) -> None:
    assert build_random(RandomDesign(space, 0.6, 1, index)).problems == ()


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (np.zeros((0, 3)), np.zeros((0, 3), int), "empty"),
        (np.full((4, 3), np.nan), np.array([[0, 1, 2]]), "finite"),
        (np.eye(3), np.array([[0, 1, 7]]), "names vertex 7"),
    ],
)
def test_unusable_input_is_refused(vertices: np.ndarray, faces: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build_finger(TriangleMesh(vertices, faces.astype(np.int32)))


def test_unknown_mount_is_refused() -> None:
    with pytest.raises(ValueError, match="stock-m3x2"):
        build_finger(expert_surface("flat_pad"), mount="glue")


def test_wall_thickness_and_gap_of_two_plates() -> None:
    parts = []
    for y in (0.0, 0.0024):  # two plates 1 mm thick, 1.4 mm apart, joined by a bar
        plate = trimesh.creation.box((0.04, 0.001, 0.04))
        plate.apply_translation((0.0, y + 0.0005, 0.0))
        parts.append(plate)
    bar = trimesh.creation.box((0.004, 0.0034, 0.04))
    bar.apply_translation((0.018, 0.0017, 0.0))
    mesh = trimesh.boolean.union([*parts, bar])
    checks = check_printing(TriangleMesh(np.array(mesh.vertices), mesh.faces.astype(np.int32)))
    assert checks.wall_p1 == pytest.approx(0.001, abs=1e-5)
    assert checks.gap_p1 == pytest.approx(0.0014, abs=1e-5)
    assert checks.thin_share > 0.7
    assert any("thinner than 1.2 mm" in problem for problem in checks.problems)
    # Printed with +y on the bed, the front plate hangs over the slot: 36 mm of its 40 mm.
    assert checks.overhang_area == pytest.approx(0.036 * 0.04, rel=1e-6)


def test_pair_loads_again_to_the_last_bit(flat: BuiltFinger, folder: Path) -> None:
    pair = load_finger_pair(folder)
    assert pair.content_hash == flat.pair.content_hash
    assert (pair.name, pair.mount, pair.cage) == ("flat", "stock-m3x2", "")


def test_meshes_of_another_finger_are_refused(folder: Path, tmp_path: Path) -> None:
    description = json.loads((folder / "finger.json").read_text())
    description["max_width"] += 1e-3
    (tmp_path / "finger.json").write_text(json.dumps(description))
    (tmp_path / "meshes.npz").write_bytes((folder / "meshes.npz").read_bytes())
    with pytest.raises(ValueError, match="hash"):
        load_finger_pair(tmp_path)


@pytest.mark.parametrize(
    ("file", "unit"), [("left.stl", 1e-3), ("right.stl", 1e-3), ("left.obj", 1), ("right.obj", 1)]
)
def test_surface_files_keep_volume_and_say_their_unit(
    flat: BuiltFinger, folder: Path, file: str, unit: float
) -> None:
    mesh = trimesh.load_mesh(folder / file)
    assert mesh.is_watertight
    assert mesh.volume * unit**3 == pytest.approx(flat.report.mesh.volume, rel=1e-5)
    head = (folder / file).read_bytes()[:80]
    assert (b"UNITS=mm" if unit < 1 else b"unit: metre") in head


def test_3mf_holds_both_fingers_with_the_mount_on_the_bed(flat: BuiltFinger, folder: Path) -> None:
    import zipfile
    from xml.etree import ElementTree

    with zipfile.ZipFile(folder / "plate.3mf") as archive:
        model = ElementTree.fromstring(archive.read("3D/3dmodel.model"))
    assert model.get("unit") == "millimeter"
    space = {"m": "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"}
    objects = model.findall(".//m:object", space)
    assert len(objects) == 2
    for item in objects:
        points = item.findall(".//m:vertex", space)
        faces = item.findall(".//m:triangle", space)
        vertices = np.array([[float(p.get(k, "nan")) for k in "xyz"] for p in points])
        index = np.array([[int(f.get(k, "-1")) for k in ("v1", "v2", "v3")] for f in faces])
        mesh = trimesh.Trimesh(vertices, index)
        assert mesh.volume * 1e-9 == pytest.approx(flat.report.mesh.volume, rel=1e-6)
        on_bed = mesh.area_faces[(mesh.triangles[..., 2] < 1e-6).all(axis=1)].sum()
        assert on_bed > 16 * 32 - 2 * np.pi * 1.6**2


def test_mjcf_weighs_and_moves_like_the_finger(flat: BuiltFinger, folder: Path) -> None:
    model = mujoco.MjModel.from_xml_path(str(folder / "fingers.xml"))
    assert model.body_mass[1:] == pytest.approx([flat.report.mesh.volume * 1240.0] * 2, rel=1e-6)
    assert model.jnt_range[0] == pytest.approx(
        (flat.pair.min_width / 2, flat.pair.max_width / 2), abs=1e-8
    )
    data = mujoco.MjData(model)
    data.qpos[:] = 0.02
    mujoco.mj_forward(model, data)
    assert data.body("left").xpos == pytest.approx((0.0, 0.02, 0.0))
    assert data.body("right").xpos == pytest.approx((0.0, -0.02, 0.0))
    assert data.body("left").xipos[1] == pytest.approx(
        0.02 + flat.report.mesh.centre_of_mass[1], abs=1e-6
    )


def test_urdf_and_convex_pieces_cover_the_finger(flat: BuiltFinger, folder: Path) -> None:
    from xml.etree import ElementTree

    robot = ElementTree.parse(folder / "fingers.urdf").getroot()
    for link in ("left", "right"):
        element = robot.find(f"link[@name='{link}']")
        assert element is not None
        mass = element.find("inertial/mass")
        assert mass is not None
        assert float(mass.get("value", "nan")) == pytest.approx(
            flat.report.mesh.volume * 1240.0, rel=1e-6
        )
        files = [m.get("filename", "") for m in element.findall("collision/geometry/mesh")]
        pieces = [trimesh.load_mesh(folder / file) for file in files]
        assert all(piece.is_convex for piece in pieces)
        assert sum(piece.volume for piece in pieces) == pytest.approx(
            flat.report.mesh.volume, rel=0.15
        )


@pytest.mark.parametrize("side", ["left", "right"])
def test_distance_grid_holds_volume_and_place(flat: BuiltFinger, folder: Path, side: str) -> None:
    with np.load(folder / f"{side}_sdf.npz") as grid:
        assert str(grid["unit"]) == "m"
        values, spacing, origin = grid["values"], float(grid["spacing"]), grid["origin"]
    inside = np.clip(0.5 - values / spacing, 0.0, 1.0)  # a cell's share, to first order
    assert inside.sum() * spacing**3 == pytest.approx(flat.report.mesh.volume, rel=0.02)
    middle = [np.average(index, weights=inside) for index in np.indices(inside.shape)]
    centre = origin + spacing * np.array(middle[::-1])
    expected = np.array(flat.report.mesh.centre_of_mass) * [1, 1 if side == "left" else -1, 1]
    np.testing.assert_allclose(centre, expected, atol=2e-4)


def test_build_command_on_parameters_and_on_a_surface(tmp_path: Path) -> None:
    space = design_space("box-7")
    write_parameters(tmp_path / "rest.json", space, np.zeros(space.parameter_count))
    out = tmp_path / "out"
    arguments = ["design", "build", "--no-simulators", "--json", "--out", str(out)]
    result = CliRunner().invoke(app, [*arguments, str(tmp_path / "rest.json")])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["valid"]
    assert load_finger_pair(out).cage == "box-7"
    page = (out / "report.html").read_text()
    assert "✓ valid" in page
    assert "data:image/png;base64," in page
    assert load_finger_pair(out).content_hash in page

    result = CliRunner().invoke(app, [*arguments, str(out / "left.stl"), "--name", "again"])
    assert load_finger_pair(out).name == "again"
    assert json.loads(result.stdout)["mesh"]["watertight"]

    result = CliRunner().invoke(app, [*arguments, str(tmp_path / "none.stl")])
    assert result.exit_code == 2


def test_batch_command_counts_valid_designs() -> None:
    arguments = ["design", "batch", "--count", "2", "--handles", "12", "--json"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    summary = json.loads(result.stdout)
    assert (summary["count"], summary["valid"]) == (2, 2)
    assert summary["median_ms"] > 0
    assert CliRunner().invoke(app, [*arguments, "--base", "cone"]).exit_code == 2
