"""Who may import whom: the rules of docs/architecture.md."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LIBRARIES = {
    "codesign_sim": set(),
    "codesign_design": set(),
    "codesign_control": set(),
    "codesign_perception": set(),
    "codesign_policy": {"codesign_sim", "codesign_design"},
    "codesign_report": {"codesign_policy", "codesign_perception"},
    "codesign_cli": {
        "codesign_sim",
        "codesign_design",
        "codesign_control",
        "codesign_perception",
        "codesign_policy",
        "codesign_report",
    },
}
ROS = {"rclpy", "ament_index_python", "codesign_interfaces", "codesign_nodes", "codesign_bringup"}


def imported(path: Path) -> set[str]:
    """Top-level names of everything that a file imports, inside functions too."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names.add(node.module.split(".")[0])
    return names


def files_of(library: str) -> list[Path]:
    return sorted((ROOT / "src" / library).rglob("*.py"))


def test_every_library_has_a_rule() -> None:
    folders = {p.name for p in (ROOT / "src").iterdir() if (p / "__init__.py").exists()}
    assert folders == set(LIBRARIES)


@pytest.mark.parametrize("library", LIBRARIES)
def test_libraries_import_only_whom_they_may(library: str) -> None:
    assert files_of(library)
    for path in files_of(library):
        ours = {name for name in imported(path) if name.startswith("codesign_")}
        assert ours <= LIBRARIES[library] | {library}, path


@pytest.mark.parametrize("library", LIBRARIES)
def test_no_library_imports_ros(library: str) -> None:
    for path in files_of(library):
        assert not imported(path) & ROS, path


def test_nodes_do_not_import_the_command_line() -> None:
    for path in (ROOT / "ros_ws" / "src").rglob("*.py"):
        assert "codesign_cli" not in imported(path), path
