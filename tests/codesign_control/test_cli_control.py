"""`codesign control`: results, and clear errors for malformed files."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from codesign_cli.control import app
from codesign_control import Xarm7

DATA = Path(__file__).parent / "data" / "xarm7_forward_kinematics.json"


def run_fk(path: Path, *options: str):
    return CliRunner().invoke(app, ["fk", "--poses", str(path), *options])


def test_fk_agrees_with_the_independent_poses() -> None:
    result = run_fk(DATA, "--json")
    assert result.exit_code == 0
    values = json.loads(result.stdout)
    assert values["poses"] == 100
    assert values["max_position_error_m"] < 1e-9
    assert values["max_rotation_error_rad"] < 1e-7


def test_fk_measures_the_error_of_a_shifted_and_a_turned_pose(tmp_path: Path) -> None:
    home = Xarm7().fk_flange(Xarm7().home)
    c, s = np.cos(0.1), np.sin(0.1)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    pose = {
        "q_rad": Xarm7().home.tolist(),
        "flange_position_m": (home.position + np.array([0.003, 0.0, 0.004])).tolist(),
        "flange_rotation": (turn @ home.rotation).tolist(),
    }
    path = tmp_path / "poses.json"
    path.write_text(json.dumps({"poses": [pose]}))
    values = json.loads(run_fk(path, "--json").stdout)
    assert values["max_position_error_m"] == pytest.approx(0.005)
    assert values["max_rotation_error_rad"] == pytest.approx(0.1)


def test_fk_prints_a_table() -> None:
    result = run_fk(DATA)
    assert result.exit_code == 0
    assert "max_position_error_m" in result.stdout


GOOD = {"q_rad": [0] * 7, "flange_position_m": [0] * 3, "flange_rotation": np.eye(3).tolist()}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "Expecting"),
        ("[]", '"poses"'),
        ('{"poses": []}', "non-empty"),
        ('{"poses": [3]}', "poses[0]: expected an object"),
        (
            json.dumps({"poses": [GOOD, {"q_rad": [0] * 7}]}),
            "poses[1]: flange_position_m is missing",
        ),
        (json.dumps({"poses": [GOOD | {"q_rad": [0] * 6}]}), "poses[0].q_rad: expected (7,)"),
        (json.dumps({"poses": [GOOD | {"q_rad": ["x"] * 7}]}), "poses[0].q_rad: not numbers"),
        (json.dumps({"poses": [GOOD | {"q_rad": [float("nan")] * 7}]}), "finite"),
        (json.dumps({"poses": [GOOD | {"flange_rotation": [[2, 0, 0]] * 3}]}), "rotation matrix"),
    ],
)
def test_fk_names_what_is_wrong_with_a_file(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "poses.json"
    path.write_text(content)
    result = run_fk(path, "--json")
    assert result.exit_code == 2
    assert message in result.output
    assert "Traceback" not in result.output


def test_fk_of_a_missing_file(tmp_path: Path) -> None:
    result = run_fk(tmp_path / "none.json")
    assert result.exit_code == 2
    assert "No such file" in result.output


def test_bench_reports_ordered_times() -> None:
    result = CliRunner().invoke(app, ["bench", "--steps", "100", "--json"])
    values = json.loads(result.stdout)
    assert 0 < values["p50_us"] <= values["p99_us"] <= values["max_us"]
