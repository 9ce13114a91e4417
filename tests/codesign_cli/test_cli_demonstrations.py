"""`codesign policy demonstrate`, `export-` and `import-demonstrations`: files, exit codes."""

import json
from pathlib import Path

import minari
from typer.testing import CliRunner

from codesign_cli.main import app

runner = CliRunner()


def test_shipped_demonstrations_become_a_lerobot_dataset(tmp_path: Path) -> None:
    out = tmp_path / "lerobot"
    done = runner.invoke(
        app, ["policy", "export-demonstrations", "wide-12", "--out", str(out), "--json"]
    )
    assert done.exit_code == 0, done.output
    summary = json.loads(done.stdout)
    assert (summary["space"], summary["transitions"]) == ("wide-12", 603)
    assert json.loads((out / "meta/info.json").read_text())["total_frames"] == 600


def test_shipped_demonstrations_are_copied_as_they_are(tmp_path: Path) -> None:
    out = tmp_path / "copy"
    command = [
        "policy",
        "export-demonstrations",
        "wide-12",
        "--format",
        "minari",
        "--out",
        str(out),
    ]
    done = runner.invoke(app, command)
    assert done.exit_code == 0, done.output
    assert minari.MinariDataset(out).total_steps == 603
    again = runner.invoke(app, ["policy", "export-demonstrations", str(out), "--out", str(out)])
    assert again.exit_code == 2
    assert "has other content" in again.output


def test_bad_input_is_named_and_nothing_is_written(tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = runner.invoke(app, ["policy", "export-demonstrations", "cube-8", "--out", str(out)])
    assert (done.exit_code, out.exists()) == (2, False)
    assert "cube-8: not demonstrations" in done.output
    missing = str(tmp_path / "bag")
    done = runner.invoke(app, ["policy", "import-demonstrations", missing, "--out", str(out)])
    assert (done.exit_code, out.exists()) == (2, False)
    assert "does not exist: give a rosbag2 folder" in done.output


def test_a_folder_with_other_content_is_refused_before_anything_is_made(tmp_path: Path) -> None:
    (tmp_path / "diary.txt").write_text("dear")
    done = runner.invoke(app, ["policy", "demonstrate", "--out", str(tmp_path)])
    assert done.exit_code == 2
    assert "has other content" in done.output
    assert [path.name for path in tmp_path.iterdir()] == ["diary.txt"]
