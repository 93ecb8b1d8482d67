"""A page about a run that needs nothing but a browser: no network and no other file."""

from __future__ import annotations

import base64
import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from gym_mara.agents.evaluation.episodes import episode_seeds
from gym_mara.agents.evaluation.metrics import METRICS, measure, statistics_in_short
from gym_mara.agents.evaluation.rollout import roll_out
from gym_mara.agents.inspection import report_figures as figures
from gym_mara.agents.inspection.report_figures import Episode
from gym_mara.agents.inspection.watch import film_episode, show_run
from gym_mara.agents.runs.evaluation import Player, options_on
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.backends import usable_backends
from gym_mara.errors import GymMaraError
from gym_mara.extras import needs
from gym_mara.files import read_text, write_text, writing

with needs("a report", "render", "jinja2"):
    from jinja2 import Environment, PackageLoader, StrictUndefined, Template
    from markupsafe import Markup

if TYPE_CHECKING:
    import plotly.graph_objects as go

_VIDEO_SECONDS = 4


def write_report(run: RunFolder, file: Path | None = None, *, which: str = "last") -> Path:
    """Play a run's policy for an episode on every backend that works here, and write a page about it and about the training.

    Args:
        run: the run.
        file: the page, a new file; by default `report.html` in the run folder, which is overwritten.
        which: the policy, "last" or "best".

    Returns:
        The file.

    Raises:
        GymMaraError: the file exists or cannot be written; the policy is missing or damaged.
        MissingExtraError: a library that draws, or the engine of the run's own backend, is not installed.
    """
    new, file = file is not None, _checked(run, file)
    config = run.config
    usable, missing = usable_backends()
    backends = [config.backend, *(name for name in usable if name != config.backend)]
    episodes = []
    for backend in backends:
        with Player(run, backend, options_on(backend, config), which=which) as player:
            steps, first = player.episode_steps, episode_seeds(0, 0, 1)
            episodes.append(Episode(backend, roll_out(player.env, player.begin, first, steps)))
            robot = player.env.simulation.robot
    page = _template().render(
        title=f"{config.env}, {config.algo.upper()}",
        subtitle=f"{config.steps:,} steps on {config.backend}, seed {config.seed}, preset {config.preset_name}; "
        f"the {which} policy, deterministic",
        episodes=episodes,
        rows=_rows(episodes),
        missing=missing,
        video_seconds=_VIDEO_SECONDS,
        video=_video(run, backends, which),
        learning_curve=_markup(figures.learning_curve(run), with_library=True),
        errors=_markup(figures.errors(episodes)),
        joints=_markup(figures.joints(episodes, robot)),
        torques=_markup(figures.torques(episodes, robot)),
        path=_markup(figures.path(episodes, episodes[0].played.target[0])),
        configuration=read_text(run.path / "config.json"),
    )
    write_text(file, page, new=new)
    return file


def _checked(run: RunFolder, file: Path | None) -> Path:
    """The file of the page; an error before anything is played if it cannot be written."""
    if file is not None and os.path.lexists(file):
        raise GymMaraError(f"{str(file)!r} exists and is not overwritten: choose another --out")
    file = file or run.path / "report.html"
    if not os.access(file.parent, os.W_OK):
        raise GymMaraError(
            f"cannot write the report {str(file)!r}: there is no folder {str(file.parent)!r} that is writable"
        )
    return file


def _template() -> Template:
    """The page's template; it escapes every value that is not Markup."""
    loader = PackageLoader("gym_mara.agents.inspection", "")
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined)
    return environment.get_template("report.html.j2")


def _markup(figure: go.Figure | None, *, with_library: bool = False) -> Markup | None:
    """A figure as HTML that is not escaped again: Plotly escapes the texts in it."""
    return None if figure is None else Markup(figures.as_html(figure, with_library=with_library))


def _rows(episodes: list[Episode]) -> list[tuple[str, list[str]]]:
    """A row for each metric that an episode has: its title, and its value on each backend."""
    measured = [measure(episode.played) for episode in episodes]
    rows = [
        (title, [statistics_in_short(name, m[name])[0] for m in measured])
        for name, title in METRICS.items()
    ]
    return [(title, values) for title, values in rows if set(values) != {"-"}]


def _video(run: RunFolder, backends: list[str], which: str) -> str:
    """A film of the policy on these backends, side by side, as base64."""
    with writing(Path(tempfile.gettempdir())), tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "video.mp4"
        size = {"width": 480, "height": 400}
        film_episode(show_run(run, which), path, backends, size, seconds=_VIDEO_SECONDS, rate=25.0)
        return base64.b64encode(path.read_bytes()).decode()
