"""gym-mara ros2: an arm behind topics, simulated or real."""

from __future__ import annotations

import typer

from gym_mara.cli.ros2 import bags, check, deploy, sim

app = typer.Typer(
    name="ros2",
    help="Connect policies to an arm of ROS 2, simulated or real. Needs the extra ros2.",
    no_args_is_help=True,
)
app.command()(check.check)
app.command()(deploy.deploy)
app.command()(bags.record)
app.command()(bags.replay)
app.command()(sim.sim)
