"""Hostile actions break no limit: 10,000 here, a million by `codesign control adversarial`."""

import json

from typer.testing import CliRunner

from codesign_cli.control import app


def test_10_000_hostile_actions_break_no_limit() -> None:
    result = CliRunner().invoke(app, ["adversarial", "--actions", "10000", "--seed", "1", "--json"])
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["violations"] == 0
    assert found["actions"] == 10_000 == found["actions_accepted"] + found["actions_rejected"]
    assert found["actions_rejected"] > 200  # NaN, infinite, huge, too short
    assert found["set_points"] > 1000
    assert found["slowest_stop_s"] <= 0.3
    # It is no proof unless the limits were met.
    met = {name for name, ticks in found["ticks_at_limit"].items() if ticks}
    assert {"JOINT", "SELF_COLLISION", "TABLE"} <= met
    worst = {limit["name"]: limit["worst"] for limit in found["limits"]}
    assert worst["joint jerk"] > 499.0
    assert worst["self distance"] < 0.02
