"""The commands and their errors."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from rich.text import Text
from typer.core import TyperGroup

from gym_mara import __version__
from gym_mara.cli import (
    FAILED,
    agents,
    environments,
    experiments,
    identify,
    recording,
    robots,
    training,
    viewing,
)
from gym_mara.cli.common import err, interruptible, out
from gym_mara.cli.ros2 import app as ros2
from gym_mara.errors import GymMaraError

# Some versions of Typer have a copy of Click, so Click's own class is not always theirs.
_UsageError: Any = typer.BadParameter.__base__


_LONGEST_MESSAGE = 2000


class _Commands(TyperGroup):
    def invoke(self, ctx: Any) -> Any:
        with interruptible("Interrupted."):
            return super().invoke(ctx)


app = typer.Typer(
    cls=_Commands,
    help="Train, evaluate and guard agents for the robot arm MARA.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        out.print(__version__, highlight=False)
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    pass


app.command()(training.train)
app.command()(agents.evaluate)
app.command()(agents.transfer)
app.command()(agents.export)
app.command()(recording.record)
app.command()(viewing.watch)
app.command()(viewing.report)
app.command()(experiments.benchmark)
app.command()(experiments.plot)
app.command()(experiments.search)
app.command()(robots.robot)
app.command()(identify.identify)
app.command("list")(environments.list_)
app.command()(environments.rewards)
app.add_typer(ros2)


def run(arguments: list[str]) -> int:
    """Run a command and return its exit code; an error that the user can correct is one line on stderr."""
    try:
        code = app(arguments, prog_name="gym-mara", standalone_mode=False)
        return code if isinstance(code, int) else 0
    except typer.Abort:  # of Typer, for a Ctrl-C while it reads the arguments
        raise KeyboardInterrupt from None
    except GymMaraError as error:
        broken = isinstance(error, robots.BrokenRobotError)  # which is what its command looks for
        return _failed(str(error), 1 if broken else FAILED)
    except _UsageError as error:
        if not arguments:  # Typer's way to show the help
            error.show()
            return FAILED
        message = error.format_message()
        if error.ctx and not isinstance(error, typer.BadParameter):
            message = f"{message.rstrip('.?')}; see {error.ctx.command_path} --help"
        return _failed(message)


def _failed(message: str, code: int = FAILED) -> int:
    # A message may quote what a stranger's file holds: line breaks, and control characters, which a terminal obeys.
    line = " ".join(message.split())
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)
    if len(line) > _LONGEST_MESSAGE:
        line = f"{line[:_LONGEST_MESSAGE]}…"
    err.print(Text.assemble(("error: ", "bold red"), line), soft_wrap=True)
    return code
