"""Which arms work, and how fast: each is loaded, moved and checked for collisions in a process of its own. Prints Markdown.

python benchmarks/arms.py arm.urdf other.urdf --ee-frame tool0
python benchmarks/arms.py arms.json

A JSON file is a list of {"name", "source", "urdf", "ee_frame", "package_dirs", "options"}. All but "urdf" may be missing,
and paths are relative to the file. Keywords that an arm needs for dynamics, by its findings, are given and shown.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import gym_mara
from gym_mara.collision import make_checker
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.robot.joint_ranges import reachable_range

ACTIONS, POSES, STEPS = 50, 1000, 100
AWAY, SPEED = 0.2, 1.0
"""How far the target of each joint is, rad (at most a quarter of its range), and how fast the joints move to it, rad/s."""
GIVEN = {"default_mass": 0.5, "velocity_limit": 1.0, "effort_limit": 20.0}
"""The values of keywords that an error asks for."""
HEADINGS = {
    "name": "arm", "file": "file", "frame": "end effector", "joints": "joints", "findings": "findings",
    "keywords": "keywords", "load": "load, s", "again": "again, s", "collides": "collides", "pinocchio": "pinocchio",
    "pinocchio_miss": "misses by, mm", "dart": "dart", "dart_hulls": "dart, hulls", "dart_miss": "misses by, mm", "mujoco": "MuJoCo",
}  # fmt: skip


def load(arm: dict[str, Any], options: dict[str, Any]) -> tuple[RobotModel, float]:
    """The robot whatever its findings, and the time that it takes, s."""
    start = time.perf_counter()
    robot = RobotModel.inspect(Path(arm["urdf"]), arm.get("ee_frame"), **options)
    return robot, time.perf_counter() - start


def asked_for(robot: RobotModel) -> dict[str, float]:
    """The keywords that the errors of a robot ask for."""
    errors = [f.remedy for f in robot.findings if f.severity == "error" and f.dynamics]
    return {name: GIVEN[name] for name in GIVEN if any(f"{name}=" in text for text in errors)}


def rate(robot: RobotModel, backend: str, seconds: float) -> str:
    """Steps a CPU second with random actions."""
    env: Any = gymnasium.make("gym_mara/MARA-v0", robot=robot, backend=backend)
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(ACTIONS)]
    steps, start = 0, time.process_time()
    while (used := time.process_time() - start) < seconds:
        _, _, terminated, truncated, _ = env.step(actions[steps % ACTIONS])
        if terminated or truncated:
            env.reset()
        steps += 1
    env.close()
    return f"{steps / used:,.0f}"


def miss(robot: RobotModel, backend: str) -> str:
    """How far the tool is from its target, mm, `STEPS` steps after the joints were given theirs: a free straight path away."""
    checker, rng = make_checker("coal", robot), np.random.default_rng(0)
    away = np.minimum(AWAY, 0.25 * (robot.upper - robot.lower))
    for _ in range(50):
        way = away * rng.choice([-1.0, 1.0], robot.num_joints)
        inside = (robot.home + way >= robot.lower) & (robot.home + way <= robot.upper)
        path = robot.home + np.linspace(0.0, 1.0, 20)[:, None] * np.where(inside, way, -way)
        if not checker.check(path).any():
            break
    else:
        return "no free path"
    position, quaternion = robot.kinematics().pose(path[-1:])
    options: dict[str, Any] = {"target_position": position[0], "target_quaternion": quaternion[0]}
    options |= {"max_joint_velocity": SPEED, "on_collision": "continue"}
    env: Any = gymnasium.make("gym_mara/MARA-v0", robot=robot, backend=backend, **options)
    env.reset(seed=0)
    for _ in range(STEPS):
        info = env.step(path[-1])[-1]
    env.close()
    return f"{1000.0 * info['position_error']:,.0f}"


def compiles_in_mujoco(robot: RobotModel) -> str:
    """Whether MuJoCo can load the arm; raises GymMaraError if it cannot."""
    from gym_mara.backends.mujoco.model import build_model

    build_model(robot, 0.002)
    return "yes"


def measure(arm: dict[str, Any], seconds: float) -> Iterator[tuple[str, str]]:
    """The results by name, each as soon as it is known; "why" is what is wrong with the arm."""
    options = dict(arm.get("options", {}))
    try:
        robot, first = load(arm, options)
        options |= (asked := asked_for(robot))
        robot, second = load(arm, options)
        found = [f for f in robot.findings if f.severity != "note"]
        yield "frame", robot.ee_frame
        yield "joints", str(robot.num_joints)
        yield "findings", ", ".join(f.severity for f in found)
        yield "keywords", ", ".join(f"`{name}={value:g}`" for name, value in asked.items())
        yield "why", "; ".join(map(str, found))
        RobotModel.load(Path(arm["urdf"]), arm.get("ee_frame"), **options)
    except GymMaraError as error:
        yield "load", "error"
        yield "why", str(error)
        return
    hulls = options | {"convex_hulls": True}
    yield "load", f"{first:.2f}"
    yield "again", f"{second:.2f}"
    q = np.random.default_rng(0).uniform(*reachable_range(robot), (POSES, robot.num_joints))
    yield "collides", f"{100 * make_checker('coal', robot).check(q).mean():.0f} %"
    measures: dict[str, Callable[[], str]] = {
        "pinocchio": lambda: rate(robot, "pinocchio", seconds),
        "pinocchio_miss": lambda: miss(robot, "pinocchio"),
        "dart": lambda: rate(robot, "dart", seconds),
        "dart_miss": lambda: miss(robot, "dart"),
        "dart_hulls": lambda: rate(load(arm, hulls)[0], "dart", seconds),
        "mujoco": lambda: compiles_in_mujoco(robot),
    }
    for name, of in measures.items():
        try:
            yield name, of()
        except GymMaraError as error:
            yield name, "error"
            yield "why", f"{name}: {error}"


def in_own_process(arm: dict[str, Any], seconds: float, timeout: float) -> dict[str, str]:
    """What `measure` finds, as far as it comes in this time, s."""
    command = [sys.executable, __file__, "--measure", json.dumps(arm), "--seconds", str(seconds)]
    try:
        done = subprocess.run(command, capture_output=True, timeout=timeout, check=False)
        lines, end = done.stdout, f"exit code {done.returncode}" if done.returncode else ""
        why = [end, done.stderr.decode(errors="replace")[-300:]]
    except subprocess.TimeoutExpired as expired:
        lines, why = expired.stdout or b"", [f"not ready after {timeout:g} s"]
    results = [json.loads(line) for line in lines.decode().splitlines()]
    why += [text for name, text in results if name == "why"]
    return dict(results) | {"why": " ".join(" ".join(why).split())}


def read_arms(file: Path, ee_frame: str | None) -> list[dict[str, Any]]:
    """The arms of a JSON file with absolute paths, or the one arm of a URDF."""
    if file.suffix != ".json":
        return [{"file": str(file), "urdf": str(file), "ee_frame": ee_frame}]
    folder = file.absolute().parent
    arms: list[dict[str, Any]] = json.loads(file.read_text())
    for arm in arms:
        arm["file"], arm["urdf"] = arm["urdf"], str(folder / arm["urdf"])
        packages = [str(folder / each) for each in arm.get("package_dirs", [])]
        arm["options"] = {"package_dirs": packages} | arm.get("options", {})
    return arms


def main() -> None:
    """Measure every arm."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="*", help="URDFs, and JSON files that list arms")
    parser.add_argument("--ee-frame", help="the end-effector link of every URDF")
    parser.add_argument("--seconds", type=float, default=3.0, help="CPU time of each rate, s")
    parser.add_argument("--timeout", type=float, default=300.0, help="of an arm, s")
    parser.add_argument("--measure", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        warnings.simplefilter("ignore")
        for result in measure(json.loads(options.measure), options.seconds):
            print(json.dumps(result), flush=True)
        return
    arms = [arm for file in options.files for arm in read_arms(Path(file), options.ee_frame)]
    print(f"gym_mara {gym_mara.__version__}; rates in steps a CPU second.\n")
    print("| " + " | ".join(HEADINGS.values()) + " |\n|" + "---|" * len(HEADINGS))
    reasons = []
    for arm in arms:
        name, source = arm.get("name", Path(arm["urdf"]).stem), arm.get("source")
        found = in_own_process(arm, options.seconds, options.timeout)
        found["name"] = f"[{name}](https://{source})" if source else name
        found["file"] = f"`{arm['file'].removeprefix(name + '/')}`"
        print("| " + " | ".join(found.get(key, "") for key in HEADINGS) + " |", flush=True)
        reasons += [f"- {name}: {found['why']}"] if found["why"] else []
    print("\nFindings, errors, and what was written to standard error:\n", *reasons, sep="\n")


if __name__ == "__main__":
    main()
