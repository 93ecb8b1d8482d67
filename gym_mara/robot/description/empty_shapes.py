"""Takes shapes without a volume out of a URDF: some engines refuse them, and DART makes them 1 m large."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

from gym_mara.robot.diagnosis import Finding

_LEAST = 1e-9
"""A length below this is zero, m."""
_LENGTHS = {
    "box": ("size",),
    "sphere": ("radius",),
    "cylinder": ("radius", "length"),
    "capsule": ("radius",),
    "mesh": ("scale",),
}
"""The attributes of each shape of which none may be zero."""


def drop_empty_shapes(root: ElementTree.Element) -> list[Finding]:
    """Change a URDF, whose numbers were checked: remove the shapes without a volume; return what was removed.

    A capsule of length zero becomes the sphere that it is.
    """
    findings = []
    for link in root.findall("link"):
        for kind in ("collision", "visual"):
            for element in link.findall(kind):
                shape = element.find("geometry/*")
                if shape is None:
                    continue
                if shape.tag == "capsule" and float(shape.get("length", "1")) < _LEAST:
                    shape.tag = "sphere"
                    del shape.attrib["length"]
                for name in _LENGTHS.get(shape.tag, ()):
                    text = shape.get(name, "1")
                    if min(abs(float(number)) for number in text.split()) < _LEAST:
                        link.remove(element)
                        findings.append(_removed(link, kind, f'<{shape.tag} {name}="{text}">'))
                        break
    return findings


def _removed(link: ElementTree.Element, kind: str, shape: str) -> Finding:
    collision = kind == "collision"
    return Finding(
        severity="warning" if collision else "note",
        part=f"link {link.get('name')}",
        message=f"its <{kind}> {shape} has no volume",
        effect=f"the shape is {'never touched' if collision else 'not drawn'} on any backend",
        remedy="Remove the element, or give the shape its size",
    )
