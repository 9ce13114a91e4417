"""Surface files: STL and 3MF for printers in millimetres, OBJ for simulators in metres."""

import zipfile
from io import BytesIO
from xml.sax.saxutils import quoteattr

import numpy as np
import trimesh
from numpy.typing import NDArray

from codesign_design.finger_pair import FingerPair, TriangleMesh
from codesign_design.solid import MM

_3MF = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
_CONTENT_TYPES = (
    '<?xml version="1.0" encoding="UTF-8"?>'
    '<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">'
    '<Default Extension="rels" '
    'ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    '<Default Extension="model" '
    'ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>'
)
_RELATIONSHIPS = (
    '<?xml version="1.0" encoding="UTF-8"?>'
    '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">'
    '<Relationship Target="/3D/3dmodel.model" Id="rel0" '
    'Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>'
)
_STL_HEADER = b"finger, grasp frame at gap 0, UNITS=mm"
_BED_GAP = 10.0  # mm, between the two fingers on the printer's bed
_DIGITS = 6  # after the point, mm: a nanometre


def stl_bytes(mesh: TriangleMesh) -> bytes:
    """Binary STL in millimetres; its header says so."""
    content = trimesh.Trimesh(mesh.vertices * MM, mesh.faces, process=False).export(file_type="stl")
    assert isinstance(content, bytes)
    return _STL_HEADER.ljust(80) + content[80:]


def obj_text(mesh: TriangleMesh, name: str) -> str:
    """OBJ in metres; its first line says so."""
    lines = [f"# {name}, grasp frame at gap 0, unit: metre", f"o {name}"]
    lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in mesh.faces + 1]
    return "\n".join(lines) + "\n"


def print_plate(pair: FingerPair) -> bytes:
    """3MF in millimetres: both fingers side by side, mount faces on the bed."""
    width = float(np.ptp(pair.left.vertices[:, 0])) * MM
    objects, items = "", ""
    for number, (side, mesh) in enumerate((("left", pair.left), ("right", pair.right)), start=1):
        turned = _mount_down(mesh.vertices * MM, upward=-1.0 if side == "left" else 1.0)
        turned[:, 0] += (number - 1) * (width + _BED_GAP) - turned[:, 0].min()
        name = quoteattr(f"{pair.name} {side}".strip())
        content = _mesh_element(turned, mesh.faces)
        objects += f'<object id="{number}" type="model" name={name}>{content}</object>'
        items += f'<item objectid="{number}"/>'
    model = (
        f'<?xml version="1.0" encoding="UTF-8"?><model unit="millimeter" xmlns="{_3MF}">'
        f"<resources>{objects}</resources><build>{items}</build></model>"
    )
    buffer = BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("[Content_Types].xml", _CONTENT_TYPES)
        archive.writestr("_rels/.rels", _RELATIONSHIPS)
        archive.writestr("3D/3dmodel.model", model)
    return buffer.getvalue()


def _mount_down(vertices: NDArray[np.float64], upward: float) -> NDArray[np.float64]:
    """Turned so that grasp y times `upward` points up from the bed; a rotation, no reflection."""
    x, y, z = vertices.T
    turned = np.stack([x, -upward * z, upward * y], axis=1)
    return turned - [0.0, turned[:, 1].min(), turned[:, 2].min()]


def _mesh_element(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> str:
    points = (f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in vertices.round(_DIGITS).tolist())
    triangles = (f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in faces.tolist())
    return (
        f"<mesh><vertices>{''.join(points)}</vertices>"
        f"<triangles>{''.join(triangles)}</triangles></mesh>"
    )
