"""Bad orders to finger_design: each is refused in words, and nothing is published."""

import math
from pathlib import Path
from typing import Any

import pytest

from codesign_design.experts import flat_pad
from codesign_design.finger_pair import TriangleMesh


@pytest.fixture
def designer(graph: Any, probe: Any, tmp_path: Path) -> Any:
    """The node, and a probe that listens to what it publishes."""
    from codesign_interfaces.msg import FingerDesign
    from codesign_nodes import qos
    from diagnostic_msgs.msg import DiagnosticArray

    graph.start("finger_design", {"output_dir": str(tmp_path / "designs")})
    probe.listen("/finger_design", FingerDesign, qos.LATCHED)
    probe.listen("/diagnostics", DiagnosticArray, 10)
    probe.wait_for(lambda: probe.received["/finger_design"], 60.0, "the stock fingers")
    return probe


def order(probe: Any, timeout: float = 150.0, **fields: Any) -> Any:
    from codesign_interfaces.srv import GenerateDesign

    request = GenerateDesign.Request(**fields)
    return probe.call("/finger_design/generate_design", GenerateDesign, request, timeout)


def message(mesh: TriangleMesh) -> Any:
    from codesign_nodes.messages import mesh_message

    return mesh_message(mesh)


def open_pad() -> TriangleMesh:
    pad = flat_pad()
    return TriangleMesh(pad.vertices, pad.faces[:-1])


def test_bad_orders_are_refused_and_nothing_is_published(designer: Any, tmp_path: Path) -> None:
    pad = flat_pad()
    not_finite = pad.vertices.copy()
    not_finite[7, 2] = math.nan
    bad: list[tuple[dict[str, Any], str]] = [
        ({}, "name '' is no expert's: there are stock, flat_pad"),
        ({"name": "spoon"}, "name 'spoon' is no expert's"),
        ({"name": "x" * 200, "parameters": [0.0] * 21}, "name has 200 characters: at most 100"),
        ({"parameters": [0.0] * 20}, "parameters have shape (20,)"),
        ({"parameters": [math.nan] * 21}, "parameter 0 is nan"),
        ({"parameters": [0.0] * 20 + [1.5]}, "parameter 20 is 1.5"),
        ({"cage": "cube-9", "parameters": [0.0] * 27}, "cube-9"),
        ({"parameters": [0.0] * 21, "target": message(pad)}, "leave one of them out"),
        ({"target": message(TriangleMesh(not_finite, pad.faces))}, "not finite"),
        ({"target": message(TriangleMesh(pad.vertices * 1e3, pad.faces))}, "is it in metres?"),
        ({"target": message(TriangleMesh(pad.vertices, pad.faces + 9))}, "beyond 140"),
        ({"target": message(open_pad())}, "closed"),
        # Sound as a mesh, but too thin to print.
        ({"cage": "box-7", "parameters": flat_cage()}, "cannot be used"),
    ]
    for fields, said in bad:
        answer = order(designer, **fields)
        assert not answer.success, fields
        assert said in answer.message
        assert not answer.files
        assert not answer.report
        assert answer.design.content_hash == ""
    assert len(designer.received["/finger_design"]) == 1
    assert not (tmp_path / "designs").exists()


def flat_cage() -> list[float]:
    """Parameters that press the body to a leaf of 0.4 mm."""
    import numpy as np

    from codesign_design.design_space import design_space

    space = design_space("box-7")
    handles = space.rest_handles.copy()
    handles[:, 0] *= 0.4 / np.ptp(space.surface([0.0] * 21).vertices[:, 0] * 1e3)
    return [float(p) for p in space.parameters_of(handles)]


def test_a_long_order_leaves_the_node_alive_and_is_cut_off(
    graph: Any, probe: Any, tmp_path: Path
) -> None:
    from codesign_interfaces.srv import GenerateDesign
    from diagnostic_msgs.msg import DiagnosticArray

    graph.start("finger_design", {"output_dir": str(tmp_path), "time_limit": 1.0})
    probe.listen("/diagnostics", DiagnosticArray, 10)
    client = probe.node.create_client(GenerateDesign, "/finger_design/generate_design")
    assert client.wait_for_service(60.0)
    fit = GenerateDesign.Request(cage="sphere-30", target=message(flat_pad()))
    first = client.call_async(fit)

    def at_work() -> bool:
        return any(
            status.name == "/finger_design" and status.message.startswith("at work")
            for _, array in probe.received["/diagnostics"]
            for status in array.status
        )

    probe.wait_for(at_work, 30.0, "diagnostics while it works")
    other = order(probe, name="stock")
    assert not other.success
    assert "another order is in hand" in other.message
    probe.wait_for(first.done, 150.0, "the end of the fit")
    assert not first.result().success
    assert first.result().message == "not done within 1 s"
    assert "in hand" not in order(probe, name="spoon").message  # the next one is taken


def test_an_unknown_initial_finger_stops_the_node(graph: Any, probe: Any) -> None:
    child = graph.start("finger_design", {"initial": "spoon"})
    probe.wait_for(lambda: child.process.poll() is not None, 90.0, "the node's end")
    assert child.process.returncode == 1
