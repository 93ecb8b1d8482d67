"""The interactive figures of a report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gym_mara.agents.evaluation.metrics import settling_time
from gym_mara.agents.evaluation.rollout import Trajectory
from gym_mara.agents.runs.folder import RunFolder, read_progress
from gym_mara.extras import needs
from gym_mara.robot import RobotModel
from gym_mara.types import Floats

with needs("a report", "render", "plotly"):
    import plotly.graph_objects as go
    from plotly.subplots import make_subplots

_COLOURS = ("#1f77b4", "#d95f02", "#2ca02c", "#9467bd", "#8c564b", "#e377c2")
_LIMIT = {"color": "#999", "dash": "dash", "width": 1}
_MAX_POINTS = 1000
"""Of a learning curve: enough for a screen, and the page stays small."""


@dataclass(frozen=True)
class Episode:
    """One episode on one backend."""

    backend: str
    played: Trajectory
    """Of one arm."""

    @property
    def seconds(self) -> Floats:
        """The time of each step (T,), s."""
        return self.played.period * np.arange(1.0, len(self.played.reward) + 1.0)

    @property
    def position_error_mm(self) -> Floats:
        """(T,)."""
        return 1000.0 * self.played.position_error[:, 0]

    @property
    def angle_deg(self) -> Floats:
        """(T,)."""
        return np.degrees(self.played.angle_error[:, 0])


Episodes = Sequence[Episode]


def learning_curve(run: RunFolder) -> go.Figure:
    """Rewards and position error against the steps of the training."""
    rows = read_progress(run.progress_file)
    figure = make_subplots(specs=[[{"secondary_y": True}]])
    for column, name, secondary in (
        ("rollout/reward_per_step", "reward per step, training", False),
        ("eval/reward_per_step", "reward per step, evaluated", False),
        ("eval/position_error_mm", "position error, evaluated", True),
    ):
        points = [(row["time/total_timesteps"], row[column]) for row in rows if column in row]
        points = points[:: max(1, len(points) // _MAX_POINTS)]
        steps, values = zip(*points, strict=True) if points else ((), ())
        mode = "lines" if name.endswith("training") else "lines+markers"
        figure.add_scatter(x=steps, y=values, name=name, mode=mode, secondary_y=secondary)
    figure.update_xaxes(title="environment steps")
    figure.update_yaxes(title="reward per step", secondary_y=False)
    figure.update_yaxes(
        title="position error, mm",
        type="log",
        exponentformat="power",
        dtick=1,
        showgrid=False,
        secondary_y=True,
    )
    return figure


def errors(episodes: Episodes) -> go.Figure:
    """Position error and angle against time."""
    figure = make_subplots(rows=1, cols=2, subplot_titles=("position error, mm", "angle, deg"))
    for number, episode in enumerate(episodes):
        for column, values in enumerate((episode.position_error_mm, episode.angle_deg), start=1):
            figure.add_scatter(**_line(number, episode, values, column == 1), row=1, col=column)
    figure.update_xaxes(title="s", range=_until_settled(episodes))
    figure.update_yaxes(type="log", exponentformat="power", dtick=1)
    return figure


def joints(episodes: Episodes, robot: RobotModel) -> go.Figure:
    """Each joint's position against time, with its limits as dashed lines."""
    values = [episode.played.q[:, 0] for episode in episodes]
    return _by_joint(episodes, values, robot, (robot.lower, robot.upper), ("rad", "m"))


def torques(episodes: Episodes, robot: RobotModel) -> go.Figure | None:
    """Each joint's torque against time, with its limits as dashed lines; None if no backend simulates torques."""
    simulated = [e for e in episodes if np.isfinite(e.played.torque).all()]
    if not simulated:
        return None
    values = [episode.played.torque[:, 0] for episode in simulated]
    limits = -robot.effort_limit, robot.effort_limit
    return _by_joint(simulated, values, robot, limits, ("Nm", "N"))


def path(episodes: Episodes, target: Floats) -> go.Figure:
    """The path of the tool in space, with the target's position (3,), m."""
    figure = go.Figure()
    for number, episode in enumerate(episodes):
        x, y, z = episode.played.tool[:, 0].T
        figure.add_scatter3d(
            x=x,
            y=y,
            z=z,
            mode="lines+markers",
            name=episode.backend,
            line={"color": _colour(number), "width": 4},
            marker={"size": 2},
        )
    x, y, z = target[:, None]
    marker = {"color": "#d62728", "size": 5, "symbol": "cross"}
    figure.add_scatter3d(x=x, y=y, z=z, mode="markers", name="target", marker=marker)
    points = np.vstack([target, *(episode.played.tool[:, 0] for episode in episodes)])
    middle = 0.5 * (points.max(axis=0) + points.min(axis=0))
    half = 0.6 * max(float(np.ptp(points, axis=0).max()), 0.01)
    axis = {"nticks": 10, "gridcolor": "#ccc"}
    axes = {
        f"{name}axis": {**axis, "title": f"{name}, m", "range": [centre - half, centre + half]}
        for name, centre in zip("xyz", middle, strict=True)
    }
    camera = {"eye": {"x": -1.4, "y": -1.4, "z": 0.9}, "center": {"x": 0.0, "y": 0.0, "z": -0.15}}
    figure.update_layout(scene={"aspectmode": "cube", **axes, "camera": camera}, height=640)
    return figure


def as_html(figure: go.Figure, *, with_library: bool) -> str:
    """A figure as a part of a page; one figure of the page must bring the library."""
    figure.update_layout(template="plotly_white", margin={"l": 60, "r": 20, "t": 40, "b": 50})
    config = {"displaylogo": False, "responsive": True}
    return figure.to_html(full_html=False, include_plotlyjs=with_library, config=config)


def _by_joint(
    episodes: Episodes,
    values: Sequence[Floats],
    robot: RobotModel,
    limits: tuple[Floats, Floats],
    units: tuple[str, str],
) -> go.Figure:
    """A subplot for each joint, three in a row.

    Args:
        episodes: E.
        values: of each episode (T, J).
        robot: the arm.
        limits: the lower and the upper ones (J,).
        units: of the values of a joint that turns, and of one that slides.
    """
    rows = -(-robot.num_joints // 3)
    figure = make_subplots(rows=rows, cols=3, subplot_titles=robot.joint_names, shared_xaxes=True)
    sliding = robot.kinematics().prismatic
    for joint in range(robot.num_joints):
        place = {"row": 1 + joint // 3, "col": 1 + joint % 3}
        for number, (episode, of_joints) in enumerate(zip(episodes, values, strict=True)):
            figure.add_scatter(**_line(number, episode, of_joints[:, joint], joint == 0), **place)
        for limit in limits:
            figure.add_hline(limit[joint], line=_LIMIT, **place)
        if joint % 3 == 0 or sliding[joint] != sliding[joint - 1]:
            figure.update_yaxes(title=units[int(sliding[joint])], **place)
    figure.update_xaxes(range=_until_settled(episodes))
    figure.update_xaxes(title="s", row=rows)
    figure.update_layout(height=240 * rows + 80)
    return figure


def _line(number: int, episode: Episode, values: Floats, in_legend: bool) -> dict[str, object]:
    """A line of an episode's values (T,) against time; clicking its legend switches the lines of all subplots."""
    return {
        "x": episode.seconds,
        "y": values,
        "name": episode.backend,
        "legendgroup": episode.backend,
        "showlegend": in_legend,
        "line": {"color": _colour(number), "width": 1.5},
    }


def _colour(number: int) -> str:
    return _COLOURS[number % len(_COLOURS)]


def _until_settled(episodes: Episodes) -> list[float]:
    """The range of time that a figure shows first, s: twice the time that the slowest of the settled arms needs."""
    times = [settling_time(e.played)[0] for e in episodes]
    settled = [time for time in times if np.isfinite(time)]
    longest = max(episode.seconds[-1] for episode in episodes)
    return [0.0, max(1.0, 2.0 * max(settled)) if settled else longest]
