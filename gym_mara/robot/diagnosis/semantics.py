"""Findings about an SRDF: what it names that the URDF lacks."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

from gym_mara.robot.description.srdf import Semantics
from gym_mara.robot.diagnosis.finding import Finding, listed

_FEW = 5
"""An SRDF of which the URDF has less than a fifth describes another robot."""


def semantics_findings(
    srdf: Path, semantics: Semantics, root: ElementTree.Element
) -> list[Finding]:
    """The findings about an SRDF.

    Args:
        srdf: its file.
        semantics: what it says.
        root: the URDF.
    """
    unknown = semantics.unknown_names(root)
    if not unknown:
        return []
    named = semantics.names
    known = len(named) - len(unknown)
    effect = "what the URDF lacks is ignored"
    if _FEW * known >= len(named):
        message = f"it names links or joints that the URDF lacks: {listed(unknown)}"
        remedy = "Correct them, unless the SRDF describes a larger robot"
    else:
        message = (
            "it seems to describe another robot: the URDF has "
            f"{known} of the {len(named)} links and joints that it names"
        )
        remedy = "Give this robot's own SRDF, or remove it"
    return [Finding("warning", f"SRDF {str(srdf)!r}", message, effect, remedy)]
