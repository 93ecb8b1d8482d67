"""gym-mara list and rewards: the commands that need no torch."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Column, Table

from gym_mara import regression
from gym_mara.agents.algorithms.registry import ALGORITHMS
from gym_mara.backends import DEFAULT_BACKEND, backend_names
from gym_mara.cli.common import EnvOption, SetOption, keyword_arguments, out
from gym_mara.errors import GymMaraError
from gym_mara.robot.catalog import robot_names
from gym_mara.robot.modules import MODULES
from gym_mara.tasks import TASKS


def list_() -> None:
    """Show the environments, the algorithms, the backends and the robots."""
    columns = Column("environment", no_wrap=True), "reward uses", "on a collision"
    table = Table(*columns, title="Environments")
    for name, task in TASKS.items():
        uses = ["distance"]
        uses += ["orientation"] if getattr(task, "orientation", False) else []
        uses += ["collision"] if getattr(task, "collision_penalty", False) else []
        table.add_row(f"gym_mara/{name}", ", ".join(uses), task.on_collision)
    out.print(table)
    table = Table("algorithm", "what it is", "presets", title="Algorithms")
    for entry in ALGORITHMS.values():
        table.add_row(entry.name, entry.summary, ", ".join(entry.presets))
    out.print(table)
    out.print("Backends:", ", ".join(backend_names()))
    out.print("Robots:", ", ".join(robot_names()) + ", or the path of a URDF")
    out.print(
        f"Modules of an arm: {', '.join(MODULES)}. In this order they make MARA, with 6 joints: "
        "a motor makes a joint at each of its two faces."
    )


def rewards(
    context: typer.Context,
    record: Annotated[Path | None, typer.Option(help="New file for the rewards.")] = None,
    check: Annotated[
        Path | None,
        typer.Option(help="Record to compare with; exits with 1 if a value has changed."),
    ] = None,
    env: EnvOption = "MARA-v0",
    backend: Annotated[
        str | None,
        typer.Option(
            help=f"Backend; by default {DEFAULT_BACKEND}, or with --check the record's own."
        ),
    ] = None,
    states: Annotated[int, typer.Option(help="How many states to record.")] = 256,
    tolerance: Annotated[float, typer.Option(help="How much a value may change.")] = 1e-9,
    settings: SetOption = [],  # noqa: B006 - Typer reads it and never changes it
) -> None:
    """Guard a reward function: record its values in a fixed set of states, or compare them with a record."""
    if (record is None) == (check is None):
        raise GymMaraError("give either --record FILE or --check FILE")
    if record is not None:
        _refuse(context, "--record compares nothing", "tolerance")
        made = regression.record(
            env, backend or DEFAULT_BACKEND, keyword_arguments(settings), states
        )
        regression.write(record, made)
        out.print(f"{states} states of {made.env} on {made.backend} recorded in {record}")
    if check is not None:
        _refuse(context, "--check takes these from the record", "env", "states", "settings")
        moved = regression.check(check, backend, tolerance)
        for value in moved:
            print(value)
        if moved:
            print(f"{len(moved)} values of {check} have changed by more than {tolerance:g}")
            raise typer.Exit(1)
        out.print(f"{check}: no value has changed by more than {tolerance:g}")


def _refuse(context: typer.Context, reason: str, *names: str) -> None:
    """Raises GymMaraError if an option that has no effect was given on the command line."""
    given = []
    for parameter in context.command.params:
        source = context.get_parameter_source(parameter.name or "")
        if parameter.name in names and source is not None and source.name == "COMMANDLINE":
            given.append(parameter.opts[0])
    if given:
        raise GymMaraError(f"{reason}: leave out {', '.join(given)}")
