"""gym-mara identify: the physical parameters of an arm, from a bag of its motion."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from gym_mara.backends import backend_settings
from gym_mara.cli.common import (
    backend_name,
    err,
    keyword_arguments,
    names_in,
    number,
    one_of,
    out,
    several,
)
from gym_mara.cli.ros2.options import CommandTopicOption, StateTopicOption
from gym_mara.errors import GymMaraError, unknown
from gym_mara.files import check_new, write_json
from gym_mara.identification.fit import identify as fit
from gym_mara.identification.identified import Identified
from gym_mara.identification.parameters import DEFAULT, PRIORS
from gym_mara.robot import RobotModel

_DEFAULT = [",".join(DEFAULT)]
_LARGE = 5e-3
"""An error from which on the parameters are doubtful, rad (m)."""


def identify(
    bag: Annotated[
        Path,
        typer.Argument(help="Folder of a bag, with joint states and commands of a moving arm."),
    ],
    robot: Annotated[str, typer.Option(help="Its robot: a name, or a URDF.")] = "mara",
    backend: Annotated[
        str,
        typer.Option(parser=backend_name, metavar="NAME", help="Backend with dynamics."),
    ] = "dart",
    out_file: Annotated[
        Path | None, typer.Option("--out", help="New JSON file for the parameters and ranges.")
    ] = None,
    parameters: Annotated[
        list[str],
        typer.Option(
            parser=several(one_of("parameter", lambda: PRIORS)),
            metavar="NAMES",
            help=f"What is identified: {', '.join(PRIORS)}.",
        ),
    ] = _DEFAULT,
    period: Annotated[
        float,
        typer.Option(parser=number(1e-3, 1.0), metavar="X", help="Control period, s."),
    ] = 0.02,
    command_topic: CommandTopicOption = None,
    state_topic: StateTopicOption = None,
    settings: Annotated[
        list[str],
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="Keyword argument of the backend, as JSON: --set physics_step=0.002.",
        ),
    ] = [],  # noqa: B006 - Typer reads it and never changes it
) -> None:
    """Find the delay, servo gains, effort limits and friction with which a backend follows a real arm best.

    The result has ranges for the keyword randomisation. Needs the extra ros2, and that of the backend.
    """
    from gym_mara.ros2.bags.logs import STATES, read_log  # rosbags is optional

    if out_file is not None:
        check_new(out_file)  # the search takes minutes
    options = keyword_arguments(settings)
    for name in options:
        if name not in (valid := backend_settings(backend)):
            hint = " Give --robot instead." if name == "robot" else ""
            raise GymMaraError(
                f"{unknown('keyword argument', name, valid, f' of the backend {backend!r}')}{hint}"
            )
    arm = RobotModel.load(robot)
    log = read_log(bag, arm, period, states=state_topic or STATES, commands=command_topic)
    err.print(f"{log.duration:.1f} s of {arm.name}; this takes some minutes", highlight=False)
    chosen = names_in("--parameters", parameters)
    found = fit(log, arm, backend, chosen, **options)
    _print(found)
    if out_file is not None:
        write_json(out_file, found.to_json(), new=True)


def _print(found: Identified) -> None:
    table = Table("parameter", "joint", "value", "range", title=f"{found.robot} on {found.backend}")
    for each in found.estimates:
        known = each.undetermined is None
        table.add_row(
            each.name,
            each.joint or "",
            f"{each.value:.4g}" if known else "",
            f"{each.low:.4g} to {each.high:.4g}"
            if known
            else f"not determined: {each.undetermined}",
        )
    out.print(table)
    table = Table("joint", "error before", "error now", title="Errors, root mean square, rad (m)")
    for joint, error in found.error.items():
        table.add_row(joint, f"{found.error_before[joint]:.2g}", f"{error:.2g}")
    out.print(table)
    if max(found.error.values()) > _LARGE:
        out.print(
            f"note: an error of more than {_LARGE:g} rad (m) is left. The backend does not follow this arm, or the search ended in a "
            "false minimum: do not trust the values, and record another motion.",
            soft_wrap=True,
        )
    ranges = ", ".join(
        f"'{name}': ({low:.4g}, {high:.4g})" for name, (low, high) in found.randomisation.items()
    )
    out.print(f"randomisation={{{ranges}}}", highlight=False)
