"""`codesign policy rollout`."""

import json

import pytest
from click.testing import Result
from typer.testing import CliRunner

from codesign_cli.main import app
from codesign_policy import rollout


def run(options: str) -> Result:
    return CliRunner().invoke(app, ["policy", "rollout", *options.split()])


def test_random_actions_print_one_json_object() -> None:
    result = run("--policy random --near --hold 5 --envs 4 --steps 40 --json")
    assert result.exit_code == 0, result.output
    summary = json.loads(result.stdout)
    assert summary["steps"] == 40
    assert summary["episodes"] == 0
    assert summary["success_rate"] is None
    assert 0.0 < summary["fastest_object_m_s"] < 5.0
    assert summary["steps_per_second"] == pytest.approx(40 / summary["seconds"])


def test_a_table_otherwise() -> None:
    result = run("--envs 4 --steps 8")
    assert result.exit_code == 0, result.output
    assert "fastest_node_m_s" in result.stdout


def test_a_block_that_is_too_fast_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    def thrown(extremes: rollout.Extremes, _: dict) -> None:
        extremes.object_speed = 6.0

    monkeypatch.setattr(rollout.Extremes, "update", thrown)
    assert run("--envs 4 --steps 4 --json").exit_code == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--steps 5 --episodes 5", "not both"),
        ("--tets 601", "no tofu mesh of 601"),
        ("--envs 2 --processes 3", "3 processes for 2 lanes"),
    ],
)
def test_bad_input_is_told(options: str, message: str) -> None:
    result = run(options)
    assert result.exit_code == 2
    assert message in result.stderr
