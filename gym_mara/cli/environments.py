"""gym-mara list and rewards: the commands that need no torch."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Column, Table

from gym_mara import regression
from gym_mara.agents.algorithms.registry import ALGORITHMS
from gym_mara.backends import DEFAULT_BACKEND, backend_names
from gym_mara.cli.common import (
    EnvOption,
    SetOption,
    backend_name,
    keyword_arguments,
    number,
    out,
    refuse,
    whole,
)
from gym_mara.errors import GymMaraError
from gym_mara.registration import environment, environment_id, environment_names
from gym_mara.robot.catalog import robot_names
from gym_mara.robot.description.modules import MODULES
from gym_mara.tasks import named_task


def list_() -> None:
    """Show the environments, the algorithms, the backends and the robots."""
    columns = Column("environment", no_wrap=True), "reward uses", "on a collision"
    table = Table(*columns, title="Environments")
    for name in environment_names():
        try:
            task = named_task(environment(name).task)
        except GymMaraError as error:  # a broken task of another package
            table.add_row(environment_id(name), str(error), "")
            continue
        uses = ["distance"]
        uses += ["orientation"] if getattr(task, "orientation", False) else []
        costs = "collision_penalty", "collision_weight"
        uses += ["collision"] if any(getattr(task, name, False) for name in costs) else []
        table.add_row(environment_id(name), ", ".join(uses), task.on_collision)
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
            parser=backend_name,
            metavar="NAME",
            help=f"Backend; by default {DEFAULT_BACKEND}, or with --check the record's own.",
        ),
    ] = None,
    states: Annotated[
        int,
        typer.Option(
            parser=whole(2, regression.MOST_STATES), metavar="N", help="How many states to record."
        ),
    ] = 256,
    tolerance: Annotated[
        float,
        typer.Option(parser=number(0, 1e9), metavar="X", help="How much a value may change."),
    ] = 1e-9,
    settings: SetOption = [],  # noqa: B006 - Typer reads it and never changes it
) -> None:
    """Guard a reward function: record its values in a fixed set of states, or compare them with a record."""
    if (record is None) == (check is None):
        raise GymMaraError("give either --record FILE or --check FILE")
    if record is not None:
        refuse(context, "--record compares nothing", "tolerance")
        made = regression.record(
            env, backend or DEFAULT_BACKEND, keyword_arguments(settings), states
        )
        regression.write(record, made)
        out.print(f"{states} states of {made.env} on {made.backend} recorded in {record}")
    if check is not None:
        refuse(
            context,
            "--check takes the environment, its keyword arguments and the states from the record",
            "env",
            "states",
            "settings",
        )
        moved = regression.check(check, backend, tolerance)
        for value in moved:
            print(value)
        if moved:
            print(f"{len(moved)} values of {check} have changed by more than {tolerance:g}")
            raise typer.Exit(1)
        out.print(f"{check}: no value has changed by more than {tolerance:g}")
