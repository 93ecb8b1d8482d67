"""A small arm of three joints, and the same arm with a fault."""

from __future__ import annotations

from pathlib import Path

from tests.helpers import write

TOOL = "tool"
"""Its end-effector frame."""
INERTIA = '<inertia ixx="0.01" iyy="0.01" izz="0.005" ixy="0" ixz="0" iyz="0"/>'
INERTIAL = f'<inertial><origin xyz="0 0 0.15"/><mass value="1"/>{INERTIA}</inertial>'
COLLISION = '<collision><origin xyz="0 0 0.15"/><geometry><box size="0.06 0.06 0.22"/></geometry></collision>'
BASE = (
    '<collision><origin xyz="0 0 -0.05"/><geometry><box size="0.3 0.3 0.1"/></geometry></collision>'
)
LIMIT = '<limit lower="-2" upper="2" effort="50" velocity="2"/>'
ORIGINS = ('xyz="0 0 0.02"', 'xyz="0 0 0.3"', 'xyz="0 0 0.3"')
FOLDED = ('xyz="0 0 0.02"', 'xyz="0 0 0.02"', 'xyz="0.04 0 0.3" rpy="0 3.14159265 0"')
"""The origins of its joints with the third link folded back beside the first, which it touches at home."""
FOLLOWER = (
    f'<link name="lf">{INERTIAL}{COLLISION}</link><joint name="jf" type="revolute"><parent link="l1"/><child link="lf"/>'
    '<origin xyz="0.1 0.2 0.2"/><axis xyz="0 1 0"/><limit lower="-4" upper="4" effort="50" velocity="4"/>'
    '<mimic joint="j2" multiplier="-1.5" offset="0.2"/></joint>'
)
"""A link beside the first one, whose joint mimics j2."""
UPRIGHT_REACH = 0.92
"""The height of the tool at home, m."""


def arm(
    *,
    inertial: str = INERTIAL,
    collision: str = COLLISION,
    base: str = BASE,
    limit: str = LIMIT,
    kind: str = "revolute",
    origins: tuple[str, ...] = ORIGINS,
    more: str = "",
) -> str:
    """The URDF of an upright arm: base, links l1 to l3, joints j1 (about z), j2 and j3 (about y), and a frame "tool".

    Args:
        inertial: of l1 to l3.
        collision: of l1 to l3.
        base: the collision shape of the base.
        limit: of the joints.
        kind: the type of the joints.
        origins: of the joints.
        more: further elements.
    """
    links = "".join(f'<link name="l{n}">{inertial}{collision}</link>' for n in (1, 2, 3))
    axes = "0 0 1", "0 1 0", "0 1 0"
    joints = "".join(
        f'<joint name="j{n}" type="{kind}"><parent link="{"base" if n == 1 else f"l{n - 1}"}"/>'
        f'<child link="l{n}"/><origin {origins[n - 1]}/><axis xyz="{axes[n - 1]}"/>{limit}</joint>'
        for n in (1, 2, 3)
    )
    return (
        f'<robot name="arm"><link name="base">{base}</link>{links}<link name="tool"/>{joints}'
        '<joint name="jt" type="fixed"><parent link="l3"/><child link="tool"/><origin xyz="0 0 0.3"/></joint>'
        f"{more}</robot>"
    )


def arm_file(folder: Path, text: str | None = None, srdf: str | None = None) -> Path:
    """Write the URDF of an arm, and an SRDF beside it, given by its content; return the URDF's path."""
    if srdf is not None:
        write(folder / "arm.srdf", f'<robot name="arm">{srdf}</robot>')
    return write(folder / "arm.urdf", arm() if text is None else text)
