"""scripts/env.sh keeps DDS on this host, unless somebody has chosen otherwise."""

import os
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
RANGE, PROFILES = "ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE"
OURS = str(ROOT / "ros_ws" / "src" / "codesign_bringup" / "config" / "fastdds.xml")


def sourced(**before: str) -> dict[str, str]:
    """The environment after sourcing, with nothing about DDS in it before but this."""
    clean = {
        name: value
        for name, value in os.environ.items()
        if name not in (RANGE, PROFILES, "RMW_IMPLEMENTATION", "ROS_DOMAIN_ID")
    }
    done = subprocess.run(
        ["bash", "-c", f". {ROOT}/scripts/env.sh && env -0"],
        env=clean | before,
        capture_output=True,
        text=True,
        check=True,
    )
    return dict(line.split("=", 1) for line in done.stdout.split("\0") if "=" in line)


@pytest.mark.parametrize("rmw", [{}, {"RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"}])
def test_fast_dds_is_given_our_profile(rmw: dict[str, str]) -> None:
    found = sourced(**rmw)
    assert (found[RANGE], found[PROFILES]) == ("SYSTEM_DEFAULT", OURS)
    assert Path(OURS).is_file()
    assert found["ROS_DOMAIN_ID"] == "42"


@pytest.mark.parametrize(
    ("before", "discovery"),
    [
        ({RANGE: "SUBNET"}, "SUBNET"),
        ({RANGE: "LOCALHOST"}, "LOCALHOST"),
        ({PROFILES: "/mine.xml"}, "LOCALHOST"),
        ({PROFILES: "/mine.xml", RANGE: "SYSTEM_DEFAULT"}, "SYSTEM_DEFAULT"),
        ({"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}, "LOCALHOST"),
    ],
)
def test_what_was_chosen_is_kept(before: dict[str, str], discovery: str) -> None:
    found = sourced(**before)
    assert found[RANGE] == discovery
    assert found.get(PROFILES) == before.get(PROFILES)


def test_sourcing_twice_changes_nothing() -> None:
    once = sourced()
    again = sourced(**{name: once[name] for name in (RANGE, PROFILES)})
    assert (again[RANGE], again[PROFILES]) == (once[RANGE], once[PROFILES])
