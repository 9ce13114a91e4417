"""`codesign policy bench`."""

import json
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from codesign_cli.main import app
from codesign_policy import presets


@pytest.fixture(autouse=True)
def small_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, preset in presets.PRESETS.items():
        small = replace(preset, hidden=(8,), batch_size=32, design_rows=4)
        monkeypatch.setitem(presets.PRESETS, name, small)


def test_bench_prints_json_alone() -> None:
    result = CliRunner().invoke(app, ["policy", "bench", "--seconds", "0.1", "--json"])
    assert result.exit_code == 0
    rates = {rate["preset"]: rate for rate in json.loads(result.stdout)["rates"]}
    assert set(rates) == {"published", "fast"}
    for name, ratio in (("published", 20.0), ("fast", 0.25)):
        rate = rates[name]
        assert rate["updates"] > 0
        per_second = rate["updates_per_cpu_second"]
        assert rate["cpu_ms_per_update"] == pytest.approx(1e3 / per_second)
        assert rate["transitions_per_cpu_second"] == pytest.approx(per_second / ratio)


def test_bench_prints_a_table() -> None:
    result = CliRunner().invoke(app, ["policy", "bench", "--seconds", "0.1"])
    assert result.exit_code == 0
    assert "published" in result.stdout
    assert "updates/CPU s" in result.stdout
