"""`codesign design fit` and `show`, end to end on a small search."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from codesign_cli.main import app
from codesign_design.design_file import read_parameters, write_stl
from codesign_design.finger_pair import TriangleMesh
from codesign_design.targets import target

RUN = CliRunner()
PNG = b"\x89PNG\r\n"


@pytest.fixture(scope="module")
def stl(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("target") / "flat.stl"
    write_stl(path, target("flat"))
    return path


def test_fit_writes_what_show_draws(stl: Path, tmp_path: Path) -> None:
    out = tmp_path / "fit"
    arguments = [str(stl), "--out", str(out), "--base", "box", "--restarts", "3", "--json"]
    result = RUN.invoke(app, ["design", "fit", *arguments])
    assert result.exit_code == 0, result.stderr
    summary = json.loads(result.stdout)
    assert summary["chamfer_mm"] < 0.6
    assert summary["iou"] > 0.8
    assert summary["seconds"] > 0
    space, parameters = read_parameters(out / "parameters.json")
    assert space.name == "box-7"
    assert parameters.tolist() == summary["parameters"]
    names = {"parameters.json", "fit.json", "fit.stl", "target.stl", "design.png", "curve.png"}
    assert {path.name for path in out.iterdir()} == names
    again = ["--target", str(out / "target.stl"), "--out", str(tmp_path / "again.png")]
    shown = RUN.invoke(app, ["design", "show", str(out / "parameters.json"), *again])
    assert shown.exit_code == 0, shown.stderr
    assert (tmp_path / "again.png").read_bytes().startswith(PNG)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--handles", "8"], "no cage 'sphere-8'"),
        (["--base", "cube"], "no cage 'cube-7'"),
        (["--unit", "cm"], "unit 'cm'"),
        (["--method", "magic"], "method 'magic'"),
        (["--restarts", "0"], "restarts is 0"),
        (["--region", "1", "1", "1", "0", "2", "2"], "lower corner first"),
    ],
)
def test_fit_refuses_wrong_arguments(
    stl: Path, tmp_path: Path, arguments: list[str], message: str
) -> None:
    result = RUN.invoke(app, ["design", "fit", str(stl), "--out", str(tmp_path / "o"), *arguments])
    assert result.exit_code == 2
    assert message in result.stderr
    assert not (tmp_path / "o").exists()


def test_fit_refuses_an_open_target_and_says_how_open(tmp_path: Path) -> None:
    flat = target("flat")
    write_stl(tmp_path / "open.stl", TriangleMesh(flat.vertices, flat.faces[1:]))
    result = RUN.invoke(app, ["design", "fit", str(tmp_path / "open.stl"), "--out", str(tmp_path)])
    assert result.exit_code == 2
    assert "open.stl is not closed: of 666 edges 3 are open" in result.stderr
    assert "fill its holes" in result.stderr


def test_show_refuses_what_is_not_there(tmp_path: Path) -> None:
    result = RUN.invoke(app, ["design", "show", str(tmp_path / "nothing.json")])
    assert result.exit_code == 2
    assert "nothing.json" in result.stderr
