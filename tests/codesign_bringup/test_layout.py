"""The viewers' layout shows topics and fields that the graph really publishes."""

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ROS = Path(__file__).parents[2] / "ros_ws" / "src"
LAYOUT = json.loads((ROS / "codesign_bringup" / "config" / "foxglove.json").read_text())
PANELS = LAYOUT["configById"]
MESSAGE_PATH = re.compile(r"(?P<topic>(?:/\w+)+)(?P<fields>(?:\.\w+)*)")


def strings(value: Any) -> Iterator[str]:
    """Every string in a JSON value, keys too."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for key, item in value.items():
            yield key
            yield from strings(item)
    elif isinstance(value, list):
        for item in value:
            yield from strings(item)


MESSAGE_PATHS = sorted({s for s in strings(PANELS) if s.startswith("/")})


@pytest.fixture(scope="module")
def types() -> dict[str, Any]:
    """Fields of every message type: Jazzy's and ours."""
    store = get_typestore(Stores.ROS2_JAZZY)
    ours: dict[str, Any] = {}
    for path in (ROS / "codesign_interfaces" / "msg").glob("*.msg"):
        ours |= get_types_from_msg(path.read_text(), f"codesign_interfaces/msg/{path.stem}")
    store.register(ours)
    return {name: dict(fields) for name, (_, fields) in store.fielddefs.items()}


@pytest.fixture(scope="module")
def published() -> dict[str, str]:
    """Topic and type of every publisher in the nodes' sources."""
    found: dict[str, str] = {}
    for path in (ROS / "codesign_nodes" / "codesign_nodes").glob("*.py"):
        tree = ast.parse(path.read_text())
        classes = {
            alias.asname or alias.name: f"{node.module.replace('.', '/')}/{alias.name}"
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom) and node.module
            for alias in node.names
        }
        parameters = declared_topics(tree)
        for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
            named = len(call.args) >= 2  # not where a base class hands its arguments on
            if named and getattr(call.func, "attr", "") == "create_publisher":
                kind, topic = call.args[0], call.args[1]
                assert isinstance(kind, ast.Name)
                if isinstance(topic, ast.Attribute):
                    name = parameters[topic.attr]
                else:
                    assert isinstance(topic, ast.Constant)
                    name = topic.value
                found[name.replace("~", f"/{path.stem}")] = classes[kind.id]
    return found


def declared_topics(tree: ast.AST) -> dict[str, str]:
    """Defaults of parameters by the attribute that keeps them: `self._topic = declare(...)`."""
    found = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Attribute):
            call = node.value
            if isinstance(call, ast.Call) and getattr(call.func, "id", "") == "declare":
                default = call.args[2]
                if isinstance(default, ast.Constant) and isinstance(default.value, str):
                    found[node.targets[0].attr] = default.value
    return found


def field_kind(types: dict[str, Any], type_name: str, fields: list[str]) -> str:
    """The primitive type, or the message type, that a chain of fields leads to."""
    for field in fields:
        assert field in types[type_name], f"{type_name} has no field {field}"
        kind, value = types[type_name][field]
        assert kind in (Nodetype.BASE, Nodetype.NAME), f"{field} is an array"
        type_name = value[0] if kind == Nodetype.BASE else value
    return type_name


def leaves(mosaic: Any) -> list[str]:
    """Panels of a mosaic; checks its splits."""
    if isinstance(mosaic, str):
        return [mosaic]
    assert set(mosaic) == {"direction", "splitPercentage", "first", "second"}
    assert mosaic["direction"] in ("row", "column")
    assert 0 < mosaic["splitPercentage"] < 100
    return leaves(mosaic["first"]) + leaves(mosaic["second"])


def test_layout_has_the_parts_of_an_export() -> None:
    assert set(LAYOUT) == {
        "configById",
        "globalVariables",
        "userNodes",
        "playbackConfig",
        "layout",
    }


def test_every_panel_is_shown_once() -> None:
    assert sorted(leaves(LAYOUT["layout"])) == sorted(PANELS)


def test_panels_are_of_kinds_that_both_viewers_have() -> None:
    kinds = {name.partition("!")[0] for name in PANELS}
    assert kinds == {"3D", "Plot", "StateTransitions", "DiagnosticSummary"}


@pytest.mark.parametrize("path", MESSAGE_PATHS)
def test_topic_and_field_are_published(
    path: str, types: dict[str, Any], published: dict[str, str]
) -> None:
    match = MESSAGE_PATH.fullmatch(path)
    assert match, path
    topic, fields = match["topic"], match["fields"].split(".")[1:]
    assert topic in published, f"nothing publishes {topic}"
    field_kind(types, published[topic], fields)


def test_plots_show_numbers(types: dict[str, Any], published: dict[str, str]) -> None:
    plots = [config for name, config in PANELS.items() if name.startswith("Plot!")]
    for line in (line for plot in plots for line in plot["paths"]):
        topic, *fields = line["value"].split(".")
        assert field_kind(types, published[topic], fields).startswith(("float", "int", "uint"))


def test_scene_and_diagnostics_show_topics_of_their_types(published: dict[str, str]) -> None:
    topics = PANELS["3D!scene"]["topics"]
    assert {published[t] for t in topics} == {"visualization_msgs/msg/MarkerArray"}
    topic = PANELS["DiagnosticSummary!nodes"]["topicToRender"]
    assert published[topic] == "diagnostic_msgs/msg/DiagnosticArray"


def test_scene_is_drawn_in_the_frame_of_the_markers() -> None:
    source = (ROS / "codesign_nodes" / "codesign_nodes" / "markers.py").read_text()
    assert f'frame_id = "{PANELS["3D!scene"]["followTf"]}"' in source
