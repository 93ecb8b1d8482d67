"""gym-mara ros2 sim: a simulated arm in real time."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, closing
from typing import Annotated, Any

import typer

from gym_mara.backends import make_backend, simulated_backends
from gym_mara.cli.common import interruptible, keyword_arguments, number, one_of, out
from gym_mara.cli.ros2.options import DomainOption, RobotOption
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel, RobotOptions
from gym_mara.state import SimState


def sim(
    robot: RobotOption = "mara",
    backend: Annotated[
        str,
        typer.Option(
            parser=one_of("backend", simulated_backends),
            metavar="NAME",
            help="Backend that simulates; gym-mara list shows all.",
        ),
    ] = "dart",
    settings: Annotated[
        list[str],
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="Keyword argument of the backend or the robot, as JSON: --set max_joint_velocity=1.57.",
        ),
    ] = [],  # noqa: B006 - Typer reads it and never changes it
    control_period: Annotated[
        float,
        typer.Option(
            parser=number(0.001, 1.0),
            metavar="X",
            help="The time between two states, s; a command waits for the next one.",
        ),
    ] = 0.02,
    clock: Annotated[
        bool, typer.Option("--clock", help="Publish the simulated time on /clock.")
    ] = False,
    view: Annotated[
        bool, typer.Option("--view", help="Show the arm in the browser; needs the extra render.")
    ] = False,
    domain: DomainOption = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            parser=number(0.1, 1e9), metavar="X", help="For how long, s; by default without end."
        ),
    ] = None,
) -> None:
    """Simulate an arm in real time, behind the topics of ros2_control, for any program of ROS 2.

    It publishes /joint_states, /robot_description and ~/contacts, follows commands on the topics of a
    joint_trajectory_controller, of a forward_position_controller and of gym-gazebo2's MARA, and has the service ~/reset. Needs
    the extra ros2.
    """
    from gym_mara.ros2.sim.arm import SimulatedArm
    from gym_mara.ros2.sim.node import SimNode

    options = keyword_arguments(settings)
    if "control_period" in options:
        raise GymMaraError("--set control_period has no effect here: give --control-period")
    of_robot: dict[str, Any] = {
        name: options.pop(name) for name in vars(RobotOptions()) if name in options
    }
    if "ee_frame" in options:
        of_robot["ee_frame"] = options.pop("ee_frame")
    options["control_period"] = control_period
    model = RobotModel.load(robot, **of_robot)
    with interruptible("Stopped."), ExitStack() as stack:
        engine = stack.enter_context(closing(make_backend(backend, model, 1, options)))
        arm = SimulatedArm(engine)
        on_tick = _shown(stack, model) if view else None
        node = stack.enter_context(
            closing(SimNode(arm, clock=clock, domain=domain, on_tick=on_tick))
        )
        node.check_alone()
        out.print(f"ready: {node.summary}", soft_wrap=True, highlight=False)
        out.file.flush()
        node.run(seconds)
        if node.pace.missed:
            out.print(f"{node.pace.missed} ticks were missed", soft_wrap=True, highlight=False)


def _shown(stack: ExitStack, model: RobotModel) -> Callable[[SimState], None]:
    """Open a window that shows the arm; returns what draws a state there."""
    from gym_mara.viewer.window import Window

    window = stack.enter_context(closing(Window(model)))
    out.print(f"view: {window.url}", soft_wrap=True, highlight=False)

    def draw(state: SimState) -> None:
        contacts = () if state.contacts is None else state.contacts[0]
        window.show(state.q[0], frozenset(link for contact in contacts for link in contact.links))

    return draw
