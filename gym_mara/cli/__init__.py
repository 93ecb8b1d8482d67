"""The command `gym-mara`."""

from __future__ import annotations

import sys

import typer
from rich.console import Console
from rich.text import Text

from gym_mara.cli import agents, environments, experiments, viewing
from gym_mara.errors import GymMaraError

app = typer.Typer(
    help="Train, evaluate and guard agents for the robot arm MARA.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command()(agents.train)
app.command()(agents.evaluate)
app.command()(agents.transfer)
app.command()(viewing.watch)
app.command()(viewing.report)
app.command()(experiments.benchmark)
app.command()(experiments.plot)
app.command()(experiments.search)
app.command("list")(environments.list_)
app.command()(environments.rewards)


def main() -> None:
    """Run the command; an error that the user can correct is printed as one line, without a traceback."""
    try:
        app()
    except GymMaraError as error:
        # A Text, because rich would read the brackets of an extra, as in gym_mara[train], as markup.
        text = Text.assemble(("error: ", "bold red"), str(error))
        Console(stderr=True).print(text, soft_wrap=True)
        sys.exit(2)
