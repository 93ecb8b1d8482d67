"""gym-mara ros2 deploy: play a policy on an arm."""

from __future__ import annotations

import signal
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.live import Live
from rich.table import Table

from gym_mara.cli.common import (
    SetOption,
    env_name,
    keyword_arguments,
    needs_agents,
    number,
    out,
)
from gym_mara.cli.policies import PRETRAINED
from gym_mara.cli.ros2.options import (
    ControllerOption,
    DomainOption,
    NamespaceOption,
    ProfileOption,
)
from gym_mara.errors import GymMaraError
from gym_mara.pretrained import pretrained_file

if TYPE_CHECKING:
    from gym_mara.deploy import OnnxPolicy
    from gym_mara.ros2.deploy import Deployment, Target

_EVERY = 0.5
"""How often the table is drawn, s."""
_OPTIONS = {"profile", "controller", "namespace", "domain", "live"}
"""Settings of the backend that have an option of their own."""
_TARGET = "X,Y,Z or X,Y,Z,QW,QX,QY,QZ"


def deploy(
    policy: Annotated[
        str,
        typer.Argument(help="A run folder, a file of gym-mara export, or pretrained with --env."),
    ],
    env: Annotated[
        str | None,
        typer.Option(
            parser=env_name, metavar="NAME", help="Environment; by default that of the training."
        ),
    ] = None,
    target: Annotated[
        str | None,
        typer.Option(
            metavar=_TARGET,
            help="The first target, m, in the world; others come on the topic /gym_mara/target, after the namespace.",
        ),
    ] = None,
    profile: ProfileOption = "trajectory",
    controller: ControllerOption = None,
    namespace: NamespaceOption = "",
    domain: DomainOption = None,
    live: Annotated[
        bool,
        typer.Option("--live", help="Move the arm. Without it, what would be sent is printed."),
    ] = False,
    seconds: Annotated[
        float | None,
        typer.Option(
            parser=number(0.1, 1e6), metavar="X", help="How long, s; by default until Ctrl-C."
        ),
    ] = None,
    settings: SetOption = [],  # noqa: B006 - Typer reads it and never changes it
) -> None:
    """Play a policy on an arm: observe, act, filter, publish. Nothing moves without --live.

    Every command passes the safety filter, which replaces no emergency stop. Needs the extras ros2 and deploy.
    """
    first = None if target is None else _parsed(target)
    given = keyword_arguments(settings)
    for name in _OPTIONS & given.keys():
        raise GymMaraError(f"--set {name} has no effect here: give --{name}")
    options = {
        **given,
        "profile": profile,
        "controller": controller,
        "namespace": namespace,
        "domain": domain,
        "live": live,
    }
    with _exported(policy, env) as exported:
        from gym_mara.ros2.deploy import Deployment
        from gym_mara.ros2.deploy_node import DeployNode
        from gym_mara.ros2.safety.filter import NO_EMERGENCY_STOP

        out.print(f"note: {NO_EMERGENCY_STOP}.", soft_wrap=True)
        if not live:
            out.print(
                "note: a dry run. Nothing is sent without --live, so that the arm stays where it is.",
                soft_wrap=True,
            )
        deployment = Deployment(exported, env, options, _note)
        with _ended_by_signals(deployment.end), closing(deployment):
            for note in deployment.link_notes:
                out.print(f"note: {note}.", soft_wrap=True)
            if first is not None:
                deployment.check(first)
            offered = DeployNode(deployment, deployment.node, _note).offered
            if first is not None:
                deployment.aim(first)
            out.print(f"ready: {offered}", soft_wrap=True)
            out.file.flush()
            with _table(deployment):
                deployment.run(seconds)
    for name, value in deployment.diagnostics.rows():
        out.print(f"{name}: {value}", soft_wrap=True)


def _note(text: str) -> None:
    out.print(text, soft_wrap=True)  # on the console of the table, which it would tear otherwise
    out.file.flush()


def _parsed(text: str) -> Target:
    """The target of --target.

    Raises:
        GymMaraError: it is neither three nor seven numbers.
    """
    from gym_mara.ros2.deploy import Target

    try:
        values = tuple(float(value) for value in text.split(","))
    except ValueError:
        values = ()
    if len(values) not in (3, 7):
        raise GymMaraError(f"--target must be {_TARGET}, m, not {text!r}")
    return Target(values[:3], values[3:] or None)


@contextmanager
def _exported(policy: str, env: str | None) -> Iterator[OnnxPolicy]:
    """The policy of a run folder, a file, or the pretrained one of an environment."""
    from gym_mara.deploy import OnnxPolicy

    if policy == PRETRAINED:
        if env is None:
            raise GymMaraError(f"{PRETRAINED} needs --env")
        yield OnnxPolicy(pretrained_file(env))
    elif not Path(policy).is_dir():
        yield OnnxPolicy(policy)
    else:
        with needs_agents():
            from gym_mara.agents.export.run import export
            from gym_mara.agents.runs.folder import RunFolder
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "policy.onnx"
            export(RunFolder.open(Path(policy)), file)
            loaded = OnnxPolicy(file)
        yield loaded


@contextmanager
def _ended_by_signals(end: Callable[[], None]) -> Iterator[None]:
    """Call a function at Ctrl-C and SIGTERM, so that the arm decelerates before the program ends."""
    signals = signal.SIGINT, signal.SIGTERM
    before = [signal.signal(number, lambda *_: end()) for number in signals]
    try:
        yield
    finally:
        for each, handler in zip(signals, before, strict=True):
            signal.signal(each, handler)


@contextmanager
def _table(deployment: Deployment) -> Iterator[None]:
    """A table of the diagnostics in the terminal, if there is one."""
    if not out.is_terminal:
        yield
        return

    def draw() -> Any:
        found = deployment.diagnostics
        table = Table("", "", title=found.status, show_header=False)
        for row in found.rows():
            table.add_row(*row)
        return table

    with Live(get_renderable=draw, console=out, refresh_per_second=1.0 / _EVERY, transient=True):
        yield
