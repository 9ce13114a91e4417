"""The include folders of the wheels' build host give way to this environment's."""

import importlib.util
from pathlib import Path
from typing import Any

SCRIPT = Path(__file__).parents[2] / "scripts" / "repair_ros_wheels.py"


def load() -> Any:
    spec = importlib.util.spec_from_file_location("repair_ros_wheels", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_both_folders_are_replaced_and_the_rest_is_kept() -> None:
    before = (
        'INTERFACE_INCLUDE_DIRECTORIES "${_IMPORT_PREFIX}/include/std_msgs;'
        "/opt/python/cp311-cp311/include/python3.11;"
        '/opt/python/cp311-cp311/lib/python3.11/site-packages/numpy/_core/include"'
    )
    after = load().repair(before, "/here/include/python3.12", "/here/numpy/_core/include")
    assert after == (
        'INTERFACE_INCLUDE_DIRECTORIES "${_IMPORT_PREFIX}/include/std_msgs;'
        '/here/include/python3.12;/here/numpy/_core/include"'
    )


def test_a_repaired_text_stays_as_it_is() -> None:
    module = load()
    once = module.repair("/opt/python/cp311-cp311/include/python3.11", "/usr/include/python3", "/n")
    assert module.repair(once, "/usr/include/python3", "/n") == once == "/usr/include/python3"
