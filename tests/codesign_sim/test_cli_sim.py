"""`codesign sim`."""

import json

import pytest
from typer.testing import CliRunner

from codesign_cli.sim import app
from codesign_sim import validation
from codesign_sim.validation import Check


def invoke(*arguments):
    return CliRunner().invoke(app, list(arguments))


def test_validate_prints_json():
    result = invoke("validate", "--case", "rotation", "--case", "spin", "--json")
    assert result.exit_code == 0
    report = json.loads(result.stdout)
    assert report["passed"] is True
    assert len(report["cases"]) == 3
    assert {"name", "expected", "measured", "tolerance", "unit", "passed"} <= set(
        report["cases"][0]
    )


def test_validate_prints_a_table():
    result = invoke("validate", "--case", "rotation")
    assert result.exit_code == 0
    assert "1 of 1 passed" in result.stdout


@pytest.fixture
def failing(monkeypatch):
    check = Check("wrong", 1.0, 2.0, 0.1, "Pa")
    monkeypatch.setitem(validation.CASES, "wrong", (lambda: [check], 0.1))


@pytest.mark.usefixtures("failing")
def test_validate_fails_with_a_failed_case():
    result = invoke("validate", "--case", "wrong", "--json")
    assert result.exit_code == 1
    assert json.loads(result.stdout)["passed"] is False
    assert "0 of 1 passed" in invoke("validate", "--case", "wrong").stdout


def test_validate_names_an_unknown_case():
    result = invoke("validate", "--case", "nonsense")
    assert result.exit_code == 2
    assert "choose from squeeze" in result.output


def test_bench_prints_rates():
    rates = json.loads(invoke("bench", "--json", "--seconds", "0.1").stdout)["rates"]
    assert [(r["tets"], r["environments"]) for r in rates] == [
        (600, 1),
        (600, 8),
        (2400, 1),
        (2400, 8),
    ]
    assert all(r["control_steps_per_second"] > 0 for r in rates)


def test_warm_up_reports_its_parts():
    result = invoke("warm-up")
    assert result.exit_code == 0
    assert "[2/2] done" in result.output
