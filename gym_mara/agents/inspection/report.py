"""A page about a run that needs nothing but a browser: no network, no other file."""

from __future__ import annotations

import base64
import html
import json
import os
import tempfile
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import numpy as np

from gym_mara.agents.inspection.rollout import Player, Trajectory, record
from gym_mara.agents.inspection.transfer import settled_after
from gym_mara.agents.inspection.watch import film_run
from gym_mara.agents.runs.evaluation import options_on
from gym_mara.agents.runs.folder import RunFolder, read_progress, write_atomically
from gym_mara.backends import backend_names
from gym_mara.backends.registry import BrokenBackendError
from gym_mara.errors import GymMaraError, MissingExtraError
from gym_mara.extras import needs
from gym_mara.robot import RobotModel

with needs("a report", "render", "plotly"):
    import plotly.graph_objects as go
    from plotly.subplots import make_subplots

_COLOURS = ("#1f77b4", "#d95f02", "#2ca02c", "#9467bd")
_LIMIT = {"color": "#999", "dash": "dash", "width": 1}
_NOTE = (
    "<p>The figures show the episode until the arm has arrived; a double click shows all of it.</p>"
)
_PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
  body { font: 16px/1.5 system-ui, sans-serif; color: #222; max-width: 68rem; margin: 2rem auto; padding: 0 1rem; }
  h1 { margin-bottom: 0; } h2 { margin-top: 2.5rem; }
  table { border-collapse: collapse; } th, td { padding: .2rem .8rem; text-align: right; border-bottom: 1px solid #ddd; }
  th:first-child, td:first-child { text-align: left; }
  video { max-width: 100%; } pre { background: #f5f6f7; padding: 1rem; overflow-x: auto; }
</style>
</head>
<body>
<h1>$title</h1>
<p>$subtitle</p>
$sections
</body>
</html>
""")


class _Episode(NamedTuple):
    """An episode on one backend, and its colour."""

    backend: str
    played: Trajectory
    colour: str

    @property
    def seconds(self) -> Any:
        return self.played.period * np.arange(1, len(self.played.reward) + 1)


def write_report(run: RunFolder, file: Path | None = None, *, which: str = "last") -> Path:
    """Play a run's policy for an episode on every backend, and write a page about it and about the training.

    Args:
        run: the run.
        file: the page, a new file; by default `report.html` in the run folder, which is made anew.
        which: the policy, "last" or "best".

    Returns:
        The file.

    Raises:
        GymMaraError: the file exists or cannot be written; the policy is missing or damaged.
        MissingExtraError: a library that draws is not installed.
    """
    if file is not None and file.exists():
        raise GymMaraError(f"{str(file)!r} exists and is not overwritten: choose another --out")
    file = file or run.path / "report.html"
    if not os.access(file.parent, os.W_OK):
        raise GymMaraError(
            f"cannot write the report {str(file)!r}: there is no folder {str(file.parent)!r} that may be written to"
        )
    config = run.config
    others = [name for name in backend_names() if name != config.backend]
    backends, missing = [config.backend], []
    for name in others:
        try:
            _open(run, name, which).env.close()
            backends.append(name)
        except (BrokenBackendError, MissingExtraError) as error:
            missing.append(str(error))
    episodes = []
    for backend, colour in zip(backends, _COLOURS, strict=False):
        with _open(run, backend, which) as player:
            robot, target = player.env.simulation.robot, player.env.simulation.goal.position[0]
            episodes.append(_Episode(backend, record(player), colour))
    sections = [
        ("The policy", _table(episodes) + "".join(f"<p>{html.escape(m)}</p>" for m in missing)),
        ("Video", _video(run, backends, which)),
        ("Learning curve", _plot(_learning_curve(run), first=True)),
        ("Error over the episode", _NOTE + _plot(_errors(episodes))),
        ("Joint positions", _plot(_joints(episodes, robot))),
        ("Joint torques", _plot(_torques(episodes, robot))),
        ("Path of the tool", _plot(_path(episodes, target))),
        ("Configuration", _configuration(run)),
    ]
    page = _PAGE.substitute(
        title=html.escape(f"{config.env}, {config.algo.upper()}"),
        subtitle=html.escape(
            f"{config.steps:,} steps on {config.backend}, seed {config.seed}, preset {config.preset_name}; "
            f"the {which} policy, deterministic"
        ),
        sections="\n".join(f"<h2>{title}</h2>\n{content}" for title, content in sections),
    )
    try:
        write_atomically(file, page)
    except OSError as error:
        raise GymMaraError(f"cannot write the report {str(file)!r}: {error}") from error
    return file


def _open(run: RunFolder, backend: str, which: str) -> Player:
    return Player(run, backend, options_on(backend, run.config), which=which)


def _table(episodes: list[_Episode]) -> str:
    columns = "backend", "position error, mm", "angle, deg", "reward per step", "collisions"
    rows = []
    for backend, played, _ in episodes:
        angle = np.degrees(played.angle_error[-1, 0])
        cells = (
            html.escape(backend),
            f"{1000.0 * played.position_error[-1, 0]:.4g}",
            f"{angle:.3g}",
            f"{played.reward.mean():.3f}",
            f"{played.collided.sum()}",
        )
        rows.append("".join(f"<td>{cell}</td>" for cell in cells))
    head = "".join(f"<th>{column}</th>" for column in columns)
    body = "".join(f"<tr>{row}</tr>" for row in rows)
    return f"<p>At the last step of an episode:</p><table><tr>{head}</tr>{body}</table>"


def _video(run: RunFolder, backends: list[str], which: str) -> str:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "video.mp4"
        size = {"width": 480, "height": 400}
        film_run(run, path, backends, size, which=which, seconds=4.0, rate=25.0)
        film = base64.b64encode(path.read_bytes()).decode()
    names = " and ".join(html.escape(name) for name in backends)
    return (
        f"<p>The first four seconds on {names}, from left to right.</p>\n"
        f'<video controls loop muted src="data:video/mp4;base64,{film}"></video>'
    )


def _learning_curve(run: RunFolder) -> go.Figure:
    rows = read_progress(run.progress_file)
    figure = make_subplots(specs=[[{"secondary_y": True}]])
    for column, name, secondary in (
        ("rollout/reward_per_step", "reward per step, training", False),
        ("eval/reward_per_step", "reward per step, evaluated", False),
        ("eval/position_error_mm", "position error, evaluated", True),
    ):
        points = [(row["time/total_timesteps"], row[column]) for row in rows if column in row]
        points = points[:: max(1, len(points) // 1000)]
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


def _errors(episodes: list[_Episode]) -> go.Figure:
    figure = make_subplots(rows=1, cols=2, subplot_titles=("position error, mm", "angle, deg"))
    for episode in episodes:
        errors = 1000.0 * episode.played.position_error, np.degrees(episode.played.angle_error)
        for column, values in enumerate(errors, start=1):
            _line(figure, episode, values[:, 0], 1, column, legend=column == 1)
    figure.update_xaxes(title="s", range=_while_moving(episodes))
    figure.update_yaxes(type="log", exponentformat="power", dtick=1)
    return figure


def _joints(episodes: list[_Episode], robot: RobotModel) -> go.Figure:
    figure, places = _grid(robot, episodes)
    for joint, (row, column) in enumerate(places):
        for episode in episodes:
            _line(figure, episode, episode.played.q[:, 0, joint], row, column, legend=joint == 0)
        for limit in (robot.lower[joint], robot.upper[joint]):
            figure.add_hline(limit, line=_LIMIT, row=row, col=column)
    figure.update_yaxes(title="rad", col=1)
    return figure


def _torques(episodes: list[_Episode], robot: RobotModel) -> go.Figure | str:
    simulated = [e for e in episodes if np.isfinite(e.played.torque).all()]
    if not simulated:
        return "None of the backends that are installed has torques; the backend dart has."
    figure, places = _grid(robot, simulated)
    for joint, (row, column) in enumerate(places):
        for episode in simulated:
            torque = episode.played.torque[:, 0, joint]
            _line(figure, episode, torque, row, column, legend=joint == 0)
        for sign in (-1.0, 1.0):
            limit = sign * robot.effort_limit[joint]
            figure.add_hline(limit, line=_LIMIT, row=row, col=column)
    figure.update_yaxes(title="Nm", col=1)
    return figure


def _path(episodes: list[_Episode], target: Any) -> go.Figure:
    figure = go.Figure()
    for episode in episodes:
        x, y, z = episode.played.tool[:, 0].T
        line = {"color": episode.colour, "width": 4}
        figure.add_scatter3d(
            x=x, y=y, z=z, mode="lines+markers", name=episode.backend, line=line, marker={"size": 2}
        )
    x, y, z = target[:, None]
    marker = {"color": "#d62728", "size": 5, "symbol": "cross"}
    figure.add_scatter3d(x=x, y=y, z=z, mode="markers", name="target", marker=marker)
    axes = {f"{axis}axis": {"title": f"{axis}, m"} for axis in "xyz"}
    figure.update_layout(
        scene={"aspectmode": "data", **axes, "camera": {"eye": {"x": -1.9, "y": -1.9, "z": 1.1}}},
        height=560,
    )
    return figure


def _while_moving(episodes: list[_Episode]) -> list[float]:
    """The part of the episode that a figure shows at first, s: until the slowest arm has arrived, and as long again."""
    arrived = (e.played.period * settled_after(e.played.position_error)[0] for e in episodes)
    return [0.0, max(1.0, 2.0 * max(arrived))]


def _grid(robot: RobotModel, episodes: list[_Episode]) -> tuple[go.Figure, list[tuple[int, int]]]:
    """A figure with a place for each joint, three in a row, its limits as dashed lines."""
    rows = -(-robot.num_joints // 3)
    figure = make_subplots(rows=rows, cols=3, subplot_titles=robot.joint_names, shared_xaxes=True)
    figure.update_xaxes(range=_while_moving(episodes))
    figure.update_xaxes(title="s", row=rows)
    figure.update_layout(height=240 * rows + 80)
    return figure, [(1 + joint // 3, 1 + joint % 3) for joint in range(robot.num_joints)]


def _line(
    figure: go.Figure, episode: _Episode, values: Any, row: int, column: int, *, legend: bool
) -> None:
    figure.add_scatter(
        x=episode.seconds,
        y=values,
        name=episode.backend,
        legendgroup=episode.backend,
        showlegend=legend,
        line={"color": episode.colour, "width": 1.5},
        row=row,
        col=column,
    )


def _plot(figure: go.Figure | str, *, first: bool = False) -> str:
    """A figure as HTML; the first brings the library along."""
    if isinstance(figure, str):
        return f"<p>{html.escape(figure)}</p>"
    figure.update_layout(template="plotly_white", margin={"l": 60, "r": 20, "t": 40, "b": 50})
    drawn: str = figure.to_html(
        full_html=False, include_plotlyjs=first, config={"displaylogo": False, "responsive": True}
    )
    return drawn


def _configuration(run: RunFolder) -> str:
    text = json.loads((run.path / "config.json").read_text())
    return f"<pre>{html.escape(json.dumps(text, indent=2))}</pre>"
