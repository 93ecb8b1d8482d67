"""gym-mara robot: what is wrong with an arm's files, what is in them, and where the arm works."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.table import Column, Table
from rich.text import Text

from gym_mara.backends import installed_backends
from gym_mara.backends.registry import backend_class
from gym_mara.cli.common import backend_name, err, keyword_arguments, out
from gym_mara.cli.robot_report import report
from gym_mara.errors import LARGEST, GymMaraError, MissingExtraError, unknown
from gym_mara.extras import needs
from gym_mara.files import MissingFileError, written_aside
from gym_mara.rendering import Pictures, RenderSettings
from gym_mara.rendering.view import View
from gym_mara.robot import RobotModel, RobotOptions, catalog
from gym_mara.robot.description.srdf import read_srdf
from gym_mara.robot.description.urdf import ee_frame_among_links
from gym_mara.robot.description.xml_files import read_xml
from gym_mara.robot.diagnosis.frames import candidate_frames
from gym_mara.robot.diagnosis.srdf_writer import disabled_pairs, srdf_text
from gym_mara.robot.options import is_path


class BrokenRobotError(GymMaraError):
    """The files of a robot are broken."""


_PICTURES = (".png", ".jpg", ".jpeg")
_COLOURS = {"error": "bold red", "warning": "yellow", "note": "dim"}


def robot(
    file: Annotated[
        str,
        typer.Argument(help="A URDF, or the name of a robot that gym-mara list shows."),
    ],
    ee_frame: Annotated[
        str | None,
        typer.Option(
            metavar="LINK", help="End-effector link; by default the one that the SRDF names."
        ),
    ] = None,
    backend: Annotated[
        str | None,
        typer.Option(
            parser=backend_name, metavar="NAME", help="Backend; by default all that are installed."
        ),
    ] = None,
    settings: Annotated[
        list[str],
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help=f"What replaces values of the files: {', '.join(vars(RobotOptions()))}.",
        ),
    ] = [],  # noqa: B006 - Typer reads it and never changes it
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON and nothing else.")] = False,
    picture: Annotated[
        Path | None,
        typer.Option(help="Write a new file, .png or .jpg: the arm in its start pose."),
    ] = None,
    write_srdf: Annotated[
        Path | None,
        typer.Option(
            help="Write a new SRDF: the pairs of links that need no check, found in random poses."
        ),
    ] = None,
) -> None:
    """Check the files of an arm: findings, joints, collision pairs, reach, and the backends on which it works.

    The exit code is 1 if the files are broken, or if the arm does not work on the backend, or on any. Needs the extra render
    for --picture.
    """
    options = RobotOptions(**_robot_options(settings))
    names = installed_backends()[0] if backend is None else [backend]
    if backend is not None:
        backend_class(backend)  # raises if it is not installed
    if picture is not None and picture.suffix.lower() not in _PICTURES:
        raise unknown("format of a picture", picture.suffix, _PICTURES)
    arm = _inspected(file, ee_frame, options)
    if write_srdf is not None:
        _write_srdf(arm, write_srdf)
        if write_srdf.absolute() == arm.urdf.absolute().with_suffix(".srdf"):
            arm = _inspected(file, ee_frame, options)  # which reads the new SRDF
    found = report(arm, names)
    if picture is not None:
        _draw(arm, found["default_target"], picture)
    if as_json:
        print(json.dumps(found, indent=2))
    else:
        _print(found)
    if all(problem is not None for problem in found["backends"].values()):
        raise typer.Exit(1)


def _robot_options(settings: list[str]) -> dict[str, Any]:
    given = keyword_arguments(settings)
    for name in given:
        if name not in vars(RobotOptions()):
            raise unknown("option of a robot", name, vars(RobotOptions()))
    return given


def _inspected(file: str, ee_frame: str | None, options: RobotOptions) -> RobotModel:
    """The arm, whatever its findings.

    Raises:
        BrokenRobotError: its files are broken.
        GymMaraError: there is no such file, robot or frame, or no frame is named.
    """
    urdf = Path(file) if is_path(file) else catalog.find(file).urdf
    with _broken():
        root = read_xml(urdf, "URDF")
    if ee_frame is not None:
        ee_frame_among_links(urdf, root, ee_frame)
    elif is_path(file):
        _require_frame(urdf, root)
    with _broken():
        return RobotModel.inspect(file, ee_frame, **vars(options))


@contextmanager
def _broken() -> Iterator[None]:
    """Raise errors about what files hold as BrokenRobotError."""
    try:
        yield
    except (MissingFileError, MissingExtraError):
        raise
    except GymMaraError as error:
        raise BrokenRobotError(str(error)) from error


def _require_frame(urdf: Path, root: ElementTree.Element) -> None:
    """Show which links can be the end-effector frame, unless an SRDF names one.

    Raises:
        GymMaraError: none does.
    """
    srdf = urdf.with_suffix(".srdf")
    with _broken():
        if srdf.is_file() and read_srdf(srdf).end_effector is not None:
            return
    frames = candidate_frames(root)
    if not frames:
        raise BrokenRobotError(f"{str(urdf)!r} has no joint that moves")
    table = Table("link", "joints that move it", "last of its chain", title="Frames")
    for frame in frames:
        table.add_row(frame.link, str(frame.joints), "yes" if frame.last else "")
    err.print(table)
    raise GymMaraError(
        f"name the end-effector link of {str(urdf)!r}, such as --ee-frame {frames[0].link}"
    )


def _write_srdf(arm: RobotModel, file: Path) -> None:
    with written_aside(file, new=True) as temporary:
        disabled = disabled_pairs(arm)
        temporary.write_bytes(srdf_text(arm, disabled).encode())
    counts = ", ".join(f"{reason} {count}" for reason, count in Counter(disabled.values()).items())
    err.print(f"{file}: {len(disabled)} pairs of links are disabled: {counts}", soft_wrap=True)


def _draw(arm: RobotModel, target: dict[str, Any], file: Path) -> None:
    with written_aside(file, new=True) as temporary:
        with needs("a picture", "render", "imageio"):
            import imageio.v2 as imageio

        view = View(arm.home, np.array(target["position"]), np.array(target["quaternion"]))
        pictures = Pictures(arm, RenderSettings(width=1280, height=960), view)
        imageio.imwrite(temporary, pictures.of(view))
        pictures.close()
    err.print(str(file), soft_wrap=True)


def _print(found: dict[str, Any]) -> None:
    table = _table("Findings", "", "part", "what is wrong", "effect", "remedy")
    for finding in sorted(found["findings"], key=lambda f: list(_COLOURS).index(f["severity"])):
        where = "with dynamics: " if finding["dynamics"] else ""
        table.add_row(
            Text(finding["severity"], _COLOURS[finding["severity"]]),
            finding["part"],
            finding["message"],
            where + finding["effect"],
            finding["remedy"],
        )
    if table.row_count:
        out.print(table)
    else:
        out.print("Nothing is wrong with the files.")
    out.print(_joints(found["joints"], found["home"]))
    counts = found["pairs"]["count"]
    excluded = ", ".join(f"{n} {why}" for why, n in counts.items() if why != "checked")
    position = ", ".join(f"{x:.3f}" for x in found["default_target"]["position"])
    out.print(
        f"Pairs of links: {counts['checked']} are checked" + (f"; {excluded}" if excluded else "")
    )
    out.print(f"Reach of {found['ee_frame']!r} from the first joint: {found['reach']:.3f} m")
    out.print(f"Default target: [{position}] m")
    for name, problem in found["backends"].items():
        out.print(f"Backend {name}: {'works' if problem is None else f'does not work: {problem}'}")


def _joints(joints: list[dict[str, Any]], home: list[float]) -> Table:
    names = "joint", "type", "limits", "start", "velocity", "effort", "axis", "moves", "kg"
    table = _table("Joints, in rad and Nm (prismatic: m and N)", *names)
    for joint, start in zip(joints, home, strict=True):
        table.add_row(
            joint["name"],
            joint["type"],
            f"{joint['lower']:.4g} to {joint['upper']:.4g}",
            f"{start:.4g}",
            *("none" if joint[n] >= LARGEST else f"{joint[n]:.4g}" for n in ("velocity", "effort")),
            " ".join(f"{x:.3g}" for x in joint["axis"]),
            joint["link"],
            f"{joint['mass']:.4g}",
        )
    return table


def _table(title: str, *columns: str) -> Table:
    """An empty table that breaks long names, and cuts nothing off."""
    return Table(*(Column(name, overflow="fold") for name in columns), title=title)
