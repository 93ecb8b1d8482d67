"""Random, hostile calls of the command gym-mara: each ends soon, without a traceback, and spares the files of others."""

from __future__ import annotations

import hashlib
import json
import os
import random
import shlex
import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import fields
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import pytest
import typer

from gym_mara import regression
from gym_mara.agents.algorithms.registry import ALGORITHMS, preset_names
from gym_mara.agents.experiments.grid import Grid, run_grid
from gym_mara.agents.export.run import export
from gym_mara.agents.runs.folder import RunConfig, RunFolder
from gym_mara.agents.training.train import train
from gym_mara.backends import backend_names, backend_settings
from gym_mara.cli.app import app
from gym_mara.envs import task_keywords
from gym_mara.envs.actions import ActionSettings
from gym_mara.envs.goal import GoalSettings
from gym_mara.envs.sensors import SensorSettings
from gym_mara.registration import ENVIRONMENTS
from gym_mara.rendering import PixelSettings, RenderSettings
from gym_mara.robot import RobotModel
from gym_mara.robot.options import ROBOT_KEYWORDS
from gym_mara.ros2.bags.logs import write_episode
from gym_mara.tasks import TASKS
from tests.cli_worker import Ended, Worker
from tests.identification.arms import hidden, log_of

NUMBERS = [
    *(
        "nan",
        "inf",
        "-inf",
        "-1",
        "0",
        "1e23",
        "1e-300",
        "1e300",
        "1" + 400 * "0",
        "1M",
        "",
        "0x10",
    ),
    *("1.5", "--", "1e", "٣x", "true", "[1]", " ", "-0.0"),
]
NAMES = ["", "MARA-v9", "None", "a,b", ",", "ppo,", "../x", "*", "[/red]", "\udcff", "n" * 3000]
OTHERS = [
    *("missing", "missing/deep/x", "folder", "fifo", "loop", "existing", "..", ".", "", "~", "-"),
    *(
        "/dev/null",
        "/dev/full",
        "/dev/zero",
        "/proc/self/mem",
        "a\udcff",
        "x" * 300,
        "folder/../new",
    ),
    *(
        "localhost",
        "://",
        "x" * 3000,
        "existing/x",
        "fifo/x",
        "loop/x",
        "new.mp4/",
        "folder/x.mp4",
        "x" * 250 + ".gif",
    ),
]
VALUES = [
    *("NaN", "-Infinity", "1e999", "9" * 400, "-1", "0", "1e-300", "1e300", "true", "null", '""'),
    *(
        "[]",
        "{}",
        "[[[]]]",
        "[" * 50_000,
        '{"a": {"a": NaN}}',
        "[1, 2",
        "'x'",
        "\udcff",
        "x" * 3000,
    ),
    *(
        "[1, 2, 3]",
        "[0, 0, 0, 0]",
        "[1e200, 0, 0]",
        '["base", "tool"]',
        "../x",
        "/dev/zero",
        "fifo",
    ),
]
STRANGE = [
    *("num_envs", "max_episode_steps", "autoreset_mode", "task", "backend", "self", "render_mode"),
    *("robt", "", "1", "a b", "__class__", "options"),
]
"""Keyword arguments that --set does not take."""
PICTURED = {
    "observation": ["pixels", "joints+pixels"],
    "pixel_size": ["32", "[24, 32]"],
    "pixel_camera": ["tool", "top", "[[2, 0, 1], [0, 0, 1]]"],
    "pixel_channels": ['["depth"]', '["rgb", "depth", "segmentation"]'],
    "pixel_randomisation": ['{"light": 0.5}', '{"camera": 0.1, "colour": 1}'],
}
"""Keyword arguments of pictures in observations, with values that they take."""
SETTINGS = [
    *("kappa=0.5", "max_joint_velocity=1", "robot=ur5", "on_collision=terminate", "robt=mara"),
    *(
        "action=relative",
        "action=cartesian",
        "servo_gain=10",
        'randomisation={"latency": [0, 0.1]}',
    ),
]
VALID: dict[str, Sequence[str]] = {
    "env": [*TASKS, "gym_mara/MARA-v0"],
    "algo": list(ALGORITHMS),
    "backend": ["pinocchio", "pinocchio", "dart", "mujoco", "warp", "ros2"],
    "policy": ["last", "best", "pretrained", "policy.onnx", "run", "ik", "hand"],
    "format": ["minari", "lerobot"],
    "pixels": ["32", "64"],
    "start": ["run"],
    "from_policy": ["last", "best"],
    "preset": preset_names(),
    "executor": ["local"],
    "steps": ["1", "300"],
    "checkpoint_every": ["200", "1e12"],
    "seed": ["0", "4294967295"],
    "seeds": ["1"],
    "episodes": ["1", "3"],
    "trials": ["1"],
    "jobs": ["1", "2"],
    "states": ["2", "16"],
    "tolerance": ["0", "1e-9"],
    "speed": ["1", "0.1", "5"],
    "seconds": ["0.1"],
    "targets": ["1", "2"],
    "run": ["run"],
    "resume": ["run"],
    "folder": ["grid"],
    "out_folder": ["new", "new/deep", "new-v0"],
    "out_file": ["new.html"],
    "video": ["new.gif", "new.mp4"],
    "file": ["mara", "ur5"],
    "ee_frame": ["ee_link", "tool0"],
    "picture": ["new.png"],
    "write_srdf": ["new.srdf"],
    "record": ["new.csv"],
    "check": ["record.csv"],
    "settings": SETTINGS,
    "target": ["-0.4,0.095,0.87", "5,0,0", "-0.4,0.1,0.7,0,1,0,0"],
    "profile": ["trajectory", "forward", "action", "mara-2019"],
    "controller": ["arm_controller"],
    "namespace": ["left", "/left/arm"],
    "robot": ["mara"],
    "command_topic": ["/commands"],
    "state_topic": ["states"],
    "control_period": ["0.02"],
    "rate": ["10"],
    "as_json": ["new.json"],
    "identify.bag": ["bag"],
    "parameters": ["joint_friction", "latency", "mass,mass"],
    "period": ["0.02", "0.02", "0.1"],
    "log": ["csv", "csv,tensorboard", "wandb"],
    "ros2 check.policy": ["policy.onnx"],
    "ros2 check.seconds": ["0.5"],
    "ros2 deploy.policy": ["policy.onnx", "pretrained", "run"],
    "ros2 record.bag": ["new", "new", "bag"],
    "ros2 record.topic": ["/joint_states"],
    "ros2 replay.bag": ["bag"],
}
"""Values of a parameter by its name, or by those of the command and the parameter."""
FORCED = {
    "identify": ["parameters"],
    "record": ["policy", "out_folder", "episodes"],
    "train": ["steps"],
    "benchmark": ["env", "algo", "steps", "seeds", "out_folder"],
    "search": ["env", "algo", "steps", "trials", "seeds", "jobs", "out_folder"],
    "ros2 check": ["seconds"],
    "ros2 deploy": ["seconds"],
    "ros2 record": ["seconds"],
    "ros2 replay": ["rate"],
    "ros2 sim": ["seconds"],
}
"""Options without which a call would take long, do nothing, or would not end."""
RARE = ("report", "search", "benchmark", "identify")
"""Commands that take seconds even with the smallest numbers."""


def _commands(group: Any, before: str = "") -> dict[str, Any]:
    """The commands of a group and of those in it, by their names with those of their groups."""
    found: dict[str, Any] = {}
    for name, command in group.commands.items():
        inner = getattr(command, "commands", None)
        found |= _commands(command, f"{before}{name} ") if inner else {before + name: command}
    return found


COMMANDS = _commands(typer.main.get_command(app))


def _keywords() -> list[str]:
    """Every keyword argument of the environments and the backends, and some that are none."""
    found = {*ROBOT_KEYWORDS}
    for backend in backend_names():
        found |= {*backend_settings(backend)}
    for name in ENVIRONMENTS:
        found |= {*task_keywords(name)}
    for settings in (ActionSettings, GoalSettings, PixelSettings, RenderSettings, SensorSettings):
        found |= {field.name for field in fields(settings)}
    return [*sorted(found), *STRANGE]


KEYWORDS = _keywords()


def arguments_of(choose: random.Random) -> list[str]:
    """A random call."""
    if choose.random() < 0.03:
        return choose.choice([[], ["--help"], ["trian"], [""], ["-"], ["train", "--stepz", "3"]])
    usual = [name for name in COMMANDS if name not in RARE]
    name = choose.choice(usual if choose.random() < 0.93 else RARE)
    forced = FORCED.get(name, [])
    hostile = choose.choice([0.0, 0.15, 0.5])
    call = name.split()
    for parameter in COMMANDS[name].params:
        if parameter.param_type_name == "argument":
            if choose.random() < 0.95:
                call.append(_value(name, parameter, choose, hostile))
        elif parameter.name in forced or choose.random() < 0.25:
            call.append(parameter.opts[0])
            if not parameter.is_flag:
                call.append(_value(name, parameter, choose, hostile))
    if "--resume" in call and choose.random() < 0.7:
        call = ["train", "--resume", call[call.index("--resume") + 1]]
    if any(parameter.name == "settings" for parameter in COMMANDS[name].params):
        call += _pictured(choose) if choose.random() < 0.15 else []
    if "--video" in call:
        call += ["--set", "width=64", "--set", "height=48"]
        call += [] if "--targets" in call else ["--seconds", "0.1"]
    return call


def _pictured(choose: random.Random) -> list[str]:
    """Options for pictures as observations, with one value that may be hostile."""
    name = choose.choice(list(PICTURED))
    value = choose.choice(PICTURED[name] if choose.random() < 0.6 else VALUES)
    return ["--set", "observation=state+pixels", "--set", f"{name}={value}"]


def _value(command: str, parameter: Any, choose: random.Random, hostile: float) -> str:
    valid = VALID.get(f"{command}.{parameter.name}") or VALID.get(parameter.name)
    if choose.random() > hostile and valid:
        return choose.choice(valid)
    if parameter.name == "settings":
        return f"{choose.choice(KEYWORDS)}={choose.choice(VALUES)}"
    if parameter.metavar in ("N", "X"):
        return choose.choice(NUMBERS)
    if parameter.metavar in ("NAME", "NAMES"):
        return choose.choice(NAMES)
    return choose.choice(OTHERS)


@pytest.fixture(scope="session")
def originals(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, its exported policy, a finished grid of one run, a record of rewards, and a bag."""
    folder = Path(tmp_path_factory.mktemp("fuzz"))
    train(
        RunConfig("MARA-v0", "ppo", "pinocchio", 512, 0),
        folder / "run",
        lambda steps, shown: None,
    )
    export(RunFolder.open(folder / "run"), folder / "policy.onnx")
    grid = Grid(("MARA-v0",), ("ppo",), 1, 512)

    def run_here(jobs: Any, on_message: Any) -> dict[str, str]:
        for job in jobs.values():
            job(lambda message: None)
        return {}

    assert run_grid(folder / "grid", grid, run_here, lambda name, message: None) == {}
    regression.write(folder / "record.csv", regression.record("MARA-v0", "pinocchio", {}, 8))
    robot = RobotModel.load("mara")
    friction = hidden(robot, 1, (0, 1), ("joint_friction",))
    log = log_of(robot, "mujoco", friction, 2.0, (0, 1))
    write_episode(folder / "bag", log, robot)
    return folder


def prepare(folder: Path, originals: Path, call: list[str], choose: random.Random) -> None:
    """Make the files that a call may find: a run, a policy, a grid, a record and a bag, perhaps damaged, and unusual files."""
    folder.mkdir()
    (folder / "folder").mkdir()
    (folder / "folder" / "bystander").write_text("mine")
    (folder / "existing").write_text("mine")
    os.mkfifo(folder / "fifo")
    (folder / "loop").symlink_to("loop")
    for name in ("run", "policy.onnx", "grid", "record.csv", "bag"):
        if name in call:
            source = originals / name
            (shutil.copytree if source.is_dir() else shutil.copy)(source, folder / name)
            if choose.random() < 0.6:
                damage(folder / name, choose)


def damage(path: Path, choose: random.Random) -> None:
    """Damage a file, or a file of a folder."""
    files = [path]
    if path.is_dir():  # the files that mark a lock are empty
        files = sorted(p for p in path.rglob("*") if p.is_file() and p.stat().st_size)
    texts = [p for p in files if p.suffix in (".json", ".csv")]
    file = choose.choice(texts if texts and choose.random() < 0.7 else files)
    content = file.read_bytes()
    kind = choose.choice(
        ["cut", "flip", "replace", "folder", "fifo", "gone", "json", "json", "json"]
    )
    if kind == "json" and file.suffix == ".json":
        file.write_text(_hostile_json(content, choose))
    elif kind == "cut":
        file.write_bytes(content[: choose.randrange(len(content))])
    elif kind in ("replace", "json"):
        file.write_bytes(
            choose.choice([b"", b"\xff\xfe", b"[" * 100_000, b"{}", b"a,b\n1\n1,2,3\n"])
        )
    elif kind == "flip":
        changed = bytearray(content)
        changed[choose.randrange(len(content))] ^= 1 << choose.randrange(8)
        file.write_bytes(changed)
    else:
        file.unlink()
        if kind == "folder":
            file.mkdir()
        elif kind == "fifo":
            os.mkfifo(file)


def _hostile_json(content: bytes, choose: random.Random) -> str:
    """JSON with one value replaced, anywhere in it."""
    values = json.loads(content)
    holder = values
    while True:
        key = choose.choice(list(holder) if isinstance(holder, dict) else range(len(holder)))
        if not isinstance(holder[key], (dict, list)) or not holder[key] or choose.random() < 0.2:
            break
        holder = holder[key]
    if choose.random() < 0.15 and isinstance(holder, dict):
        key = "additional"
    holder[key] = "\0"
    hostile = [
        *(
            "null",
            "true",
            "-1",
            "1e999",
            "NaN",
            "9" * 400,
            '""',
            '"../x"',
            "[]",
            "{}",
            "[[1]]",
            "0",
        ),
        *('{"viewer_host": "0.0.0.0"}', '{"num_envs": 4}', '{"self": 1}', "[" * 5000, '"\\ud800"'),
    ]
    return json.dumps(values).replace('"\\u0000"', choose.choice(hostile))


def tree(folder: Path) -> dict[str, str]:
    """Every path in a folder with a digest of what is there."""
    found = {}
    for path in folder.rglob("*"):
        plain = path.is_file() and not path.is_symlink()
        content = (
            hashlib.sha1(path.read_bytes()).hexdigest() if plain else str(path.lstat().st_mode)
        )
        found[os.fspath(path.relative_to(folder))] = content
    return found


def may_write(call: list[str], path: str) -> bool:
    """Whether a call was told to write to a path."""
    told = [os.path.normpath(argument) for argument in call if argument not in ("", ".", " ")]
    if "--out" not in call:
        told.append("runs")
    parents = [path, *map(str, Path(path).parents)]
    # A file that exists is neither replaced nor changed, and a folder that is not of the command is left alone.
    spared = ("folder/bystander", "existing", "fifo", "loop")
    makes_parent = any(str(name).startswith(f"{path}/") for name in told)
    return path not in spared and (makes_parent or any(parent in told for parent in parents))


def faults(
    call: list[str], ended: Ended, before: dict[str, str], after: dict[str, str]
) -> list[str]:
    """What is wrong with the end of a call."""
    found = []
    if ended.code not in (0, 1, 2, 130):
        found.append(f"it ended with {ended.code}")
    if ended.code == 2 and call and not ended.output.strip():
        found.append("an error without a message")
    if "Traceback" in ended.output:
        found.append("a traceback")
    if ended.children:
        found.append(f"processes left behind: {ended.children}")
    changed = {path for path in before.keys() | after.keys() if before.get(path) != after.get(path)}
    if strange := sorted(path for path in changed if not may_write(call, path)):
        found.append(f"files changed: {strange[:5]}")
    return found


def run_calls(seeds: range, originals: Path, folder: Path) -> list[str]:
    """Run the calls of these seeds in two processes; returns a text for each call that went wrong."""
    idle: SimpleQueue[Worker] = SimpleQueue()

    def check(seed: int) -> str:
        choose = random.Random(seed)
        call, place = arguments_of(choose), folder / str(seed)
        prepare(place, originals, call, choose)
        before, outside = tree(place), tree(originals)
        worker = idle.get()
        try:
            ended = worker.call(call, place)
        finally:
            idle.put(worker)
        found = faults(call, ended, before, tree(place))
        if tree(originals) != outside:
            found.append("files outside the folder changed")
        shutil.rmtree(place)
        shown = shlex.join(argument[:80] for argument in call)
        return f"seed {seed}: gym-mara {shown}\n{found}\n{ended.output[-1500:]}" if found else ""

    with closing(Worker()) as first, closing(Worker()) as second, ThreadPoolExecutor(2) as pool:
        idle.put(first)
        idle.put(second)
        return [text for text in pool.map(check, seeds) if text]


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [range(150)], ids=["150 calls"])
def test_hostile_calls(seeds: range, originals: Path, tmp_path: Path) -> None:
    found = run_calls(seeds, originals, tmp_path)
    assert not found, "\n\n".join(["", *found])


@pytest.mark.nightly
def test_more_hostile_calls(originals: Path, tmp_path: Path) -> None:
    found = run_calls(range(150, 3150), originals, tmp_path)
    assert not found, "\n\n".join(["", *found])


def test_the_checks_find_faults() -> None:
    before = {"existing": "1", "folder": "16877", "folder/bystander": "2", "run/config.json": "3"}
    assert faults(["plot", "run"], Ended(0, "", []), before, {**before, "run/table.md": "4"}) == []
    wrong = [
        (["list"], Ended(None, "no end", []), before),
        (["list"], Ended(-11, "", []), before),
        (["list"], Ended(2, "", []), before),
        (["list"], Ended(2, "Traceback (most recent call last):", []), before),
        (["list"], Ended(0, "", ["python -c spawn_main"]), before),
        (["report", "run"], Ended(0, "", []), {**before, "folder/new.html": "4"}),
        (["report", "run", "--out", "existing"], Ended(0, "", []), {**before, "existing": "4"}),
        (["train", "--out", "folder"], Ended(0, "", []), before | {"folder/bystander": "gone"}),
    ]
    for call, ended, after in wrong:
        assert len(faults(call, ended, before, after)) == 1
