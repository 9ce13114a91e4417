"""What Python and the native headers must agree on."""

import re
from pathlib import Path

import pytest

import codesign_sim
from codesign_sim import kernels

NATIVE = Path(codesign_sim.__file__).parent / "native"


def test_settings_are_in_the_order_of_the_header():
    body = re.search(r"enum Setting \{(.*?)\}", (NATIVE / "contact.h").read_text(), re.DOTALL)[1]
    names = re.findall(r"^\s*([A-Z_]+)", body, re.MULTILINE)
    assert tuple(name.lower() for name in names) == kernels.SETTINGS


@pytest.mark.parametrize("header", ["lanes.h", "team.h"])
def test_items_side_by_side_are_those_of_the_header(header):
    name, value = re.search(
        r"(ITEM_LANES|TEAM_LANES) = (\d+)", (NATIVE / header).read_text()
    ).groups()
    assert int(value) == getattr(kernels, name)


def test_every_header_is_part_of_the_cache_key():
    assert {path.name for path in NATIVE.glob("*.h")} == set(kernels._HEADERS)
