"""What the pages say about the environments, from the environments themselves: it replaces comments such as `<!-- facts MARA-v0 -->`."""

import csv
import dataclasses
import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import imageio.v3 as imageio
import numpy as np
from gymnasium.spaces import Dict
from numpy.typing import NDArray
from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer

from gym_mara.backends import DEFAULT_BACKEND
from gym_mara.envs import MaraGoalEnv
from gym_mara.registration import ENVIRONMENTS, Environment, environment_id
from gym_mara.tasks import Part, Task, named_task, observation
from gym_mara.tasks.arm_parts import ArmParts

DOCS = Path(__file__).resolve().parents[1]
PICTURES = DOCS / "_build" / "pictures"
_COMMENT = re.compile(r"^<!-- (facts|results|overview) ?(\S*) -->$", re.M)
_TARGET = ("target_position", "target_quaternion")
"""Fields that a task refuses if it draws its targets."""
_RESULTS = {
    "position error, mm": ".4f",
    "angle, deg": ".2f",
    "reward per step": ".2f",
    "collisions": ".0f",
    "steps to 10 mm": ",.0f",
    "wall time, s": ".0f",
}
"""The columns of a table of results that are shown, and their formats."""


def overview() -> str:
    """A table of all environments."""
    rows = []
    for name, made in ENVIRONMENTS.items():
        task = named_task(made.task)
        rows.append(
            [
                f"[{name}](environments/{name}.md)",
                "drawn" if task.random_goal else "fixed",
                "pose" if getattr(task, "orientation", False) else "position",
                task.default_action,
                task.on_collision,
                made.max_episode_steps,
            ]
        )
    head = ["environment", "target", "of the tool", "actions", "after a collision", "steps"]
    return _table(head, rows)


def facts(name: str) -> str:
    """The picture, the spaces, the reward and the keyword arguments of an environment."""
    made = ENVIRONMENTS[name]
    env: Any = gymnasium.make(
        environment_id(name),
        backend=DEFAULT_BACKEND,  # that of MARAReal-v0 waits for an arm
        render_mode="rgb_array",
        width=480,
        height=360,
    )
    env.reset(seed=0)
    task = named_task(made.task)
    picture = _picture(name, env, until_collision=getattr(task, "collision_penalty", False))
    *_, info = env.step(env.action_space.sample())
    texts = [picture, _observation(env), _action(env), _reward(made, task, info)]
    env.close()
    return "\n\n".join([*texts, _episode(made, task), _keywords(made, task)])


def results(name: str) -> str:
    """The rows of an environment in the table of the presets `tuned`."""
    with (DOCS / "benchmark" / "tuned" / "table.csv").open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["environment"] == name]
    shown = [
        [row["algorithm"].upper(), row["seeds"], *(_interval(row, column) for column in _RESULTS)]
        for row in rows
    ]
    return (
        "## Results\n\nThe presets `tuned` after a million steps, on two cores: the interquartile mean over the seeds and its "
        f"95 % bootstrap interval.\n\n{_table(['algorithm', 'seeds', *_RESULTS], shown)}"
    )


def _interval(row: dict[str, str], column: str) -> str:
    numbers = [float(row[f"{column}, {end}"]) for end in ("iqm", "low", "high")]
    if not np.isfinite(numbers[0]):
        return "-"
    middle, low, high = (format(number, _RESULTS[column]) for number in numbers)
    return middle if low == middle == high else f"{middle} [{low}, {high}]"


def _picture(name: str, env: Any, *, until_collision: bool) -> str:
    """Draw the start of an episode, or the first collision of random actions."""
    env.action_space.seed(0)
    what = "The start of an episode"
    if until_collision:
        what = "A collision: the links that collide are red"
        while not env.step(env.action_space.sample())[4]["collided"]:
            pass
    PICTURES.mkdir(parents=True, exist_ok=True)
    imageio.imwrite(PICTURES / f"{name}.png", env.render())
    return f"![{what}](../_build/pictures/{name}.png)\n\n{what}. The target is the thick frame, the tool the thin one."


def _observation(env: Any) -> str:
    simulation, space = env.unwrapped.simulation, env.observation_space
    if isinstance(space, Dict):
        form = "A dictionary: " + ", ".join(
            f"`{name}` {box.shape}" for name, box in space.spaces.items()
        )
    else:
        form = f"An array {space.shape}"
    rows = [
        [f"`{part.name}`", len(part.low), _range(part.low, part.high), _unit(part), _meaning(part)]
        for part in simulation.observation.parts
    ]
    head = ["part", "size", "range", "unit", "meaning"]
    return f"## Observation\n\n{form} of {space.dtype or 'float64'}, of these parts in this order:\n\n{_table(head, rows)}"


def _unit(part: Part) -> str:
    """The unit of a part of MARA's observation: its joints turn."""
    return part.unit.replace("joint", "rad")


def _meaning(part: Part) -> str:
    """The first sentence of the docstring of what makes a part."""
    makers = (
        getattr(observation, part.name, None),
        getattr(ArmParts, f"{part.name}_at_scales", None),
        getattr(ArmParts, part.name, None),
    )
    maker = next(filter(None, makers))
    return _plain(inspect.getdoc(maker) or "").partition("\n\n")[0].replace("\n", " ")


def _action(env: Any) -> str:
    space, actions = env.action_space, env.unwrapped.simulation.actions
    return (
        f"## Action\n\nAn array {space.shape} of {space.dtype}, {_range(space.low, space.high)}: {actions.meaning}. "
        f'This is `action="{actions.mode}"`; [environments](../environments.md#action) has the other modes.'
    )


def _reward(made: Environment, task: Task, info: dict[str, Any]) -> str:
    text = _plain(inspect.getdoc(type(task).reward) or "")
    if made.goals:
        text = (
            f'With `reward_type="sparse"` 0 within the tolerances, else -1. With `"dense"`: {text}'
        )
    keys = ", ".join(f"`{key}`" for key in sorted(info))
    return f"## Reward\n\n{text}\n\n`info` has {keys}."


def _episode(made: Environment, task: Task) -> str:
    target = "drawn for each episode" if task.random_goal else "always the same"
    return (
        f"## Episode\n\n{made.max_episode_steps} steps. The target is {target}. "
        f'After a collision: `on_collision="{task.on_collision}"`.'
    )


def _keywords(made: Environment, task: Task) -> str:
    """The keyword arguments of the task, with the defaults of this environment."""
    docs: dict[str, str] = {}
    for cls in reversed(type(task).__mro__):
        if cls.__module__.startswith("gym_mara"):
            found = ModuleAnalyzer.for_module(cls.__module__).find_attr_docs()
            docs |= {
                name: " ".join(text)
                for (owner, name), text in found.items()
                if owner == cls.__name__
            }
    refused = _TARGET if task.random_goal else ()
    fields = [field.name for field in dataclasses.fields(task) if field.name not in refused]
    rows = [[f"`{name}`", f"`{_plain_value(getattr(task, name))}`", docs[name]] for name in fields]
    if made.goals:
        rows = _goal_keywords() + rows
    return f"## Keyword arguments\n\n{_table(['keyword', 'default', 'meaning'], rows)}"


def _goal_keywords() -> list[list[str]]:
    signature = inspect.signature(MaraGoalEnv.__init__)
    docs = dict(re.findall(r"^    (\w+): (.*)$", inspect.getdoc(MaraGoalEnv) or "", re.M))
    return [
        [f"`{name}`", f"`{parameter.default!r}`", docs[name]]
        for name, parameter in signature.parameters.items()
        if parameter.kind is parameter.KEYWORD_ONLY
    ]


def _plain_value(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else repr(value)


def _range(low: NDArray[Any], high: NDArray[Any]) -> str:
    several = np.ptp(low) > 1e-6 or np.ptp(high) > 1e-6
    return f"{'within ' if several else ''}{low.min():.4g} to {high.max():.4g}"


def _plain(docstring: str) -> str:
    """A docstring as a line of Markdown."""
    return docstring.replace("*", r"\*")


def _table(head: list[str], rows: list[list[Any]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(
        "| " + " | ".join(str(cell).replace("|", r"\|") for cell in line) + " |" for line in lines
    )


def _fill(app: Sphinx, page: str, text: list[str]) -> None:
    made: dict[str, Callable[[str], str]] = {
        "facts": facts,
        "results": results,
        "overview": lambda _: overview(),
    }

    def filled(comment: re.Match[str]) -> str:
        return made[comment[1]](comment[2])

    text[0] = _COMMENT.sub(filled, text[0])


def _always(app: Sphinx, env: Any, *_: Any) -> list[str]:
    """The pages to read again although they have not changed: the environments may have."""
    return [page for page in env.found_docs if page.startswith("environments/")]


def setup(app: Sphinx) -> dict[str, Any]:
    """Sphinx calls this for an extension."""
    app.connect("source-read", _fill, priority=400)  # before the links are made those of the site
    app.connect("env-get-outdated", _always)
    return {"parallel_read_safe": True}
