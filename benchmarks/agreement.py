"""How much the backends with dynamics differ: free motions, arms at rest, and arms that press against an obstacle. Prints Markdown.

    python benchmarks/agreement.py

MARA moves from zero to random targets, for 2 s, on every backend with its default settings. On `dart`, half of these motions touch
nothing, and half end in contact.
"""

from __future__ import annotations

import functools
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np
from timing import row

from gym_mara.backends import make_backend
from gym_mara.robot import RobotModel
from gym_mara.state import SimState
from gym_mara.testing import uniform_q
from gym_mara.types import Floats

MOTIONS, CANDIDATES = 32, 256
STEPS = 100
"""Control periods of a motion, 2 s; then as many again at the target."""
REFERENCE = "dart"
BACKENDS: dict[str, dict[str, Any]] = {REFERENCE: {}, "mujoco": {}, "warp": {"device": "cpu"}}
PACKAGES = "dartpy", "mujoco", "mujoco-warp"


@functools.cache
def robot() -> RobotModel:
    """The arm."""
    return RobotModel.load("mara")


class Motion(NamedTuple):
    """What N arms did."""

    q: Floats
    """Joint positions after each step (T, N, J), rad."""
    torque: Floats
    """Motor torques at the end (N, J), Nm."""
    depth: Floats
    """The deepest contact of each step (T, N), m."""


def move(name: str, targets: Floats, **options: Any) -> Motion:
    """Arms that start at zero and move to their targets (N, J), rad."""
    backend = make_backend(name, robot(), len(targets), options)
    backend.reset(np.zeros_like(targets))
    states = [backend.step(targets) for _ in range(2 * STEPS)]
    backend.close()
    depth = np.array([_depths(state) for state in states])
    torque = states[-1].torque
    return Motion(
        np.array([state.q for state in states]),
        np.zeros_like(targets) if torque is None else torque,
        depth,
    )


def _depths(state: SimState) -> list[float]:
    """The deepest contact of each arm, m; 0 without one."""
    contacts = state.contacts or [()] * len(state.q)
    return [max((contact.depth for contact in found), default=0.0) for found in contacts]


def differences(name: str, free: Floats, pressing: Floats, reference: Motion) -> dict[str, float]:
    """What the table says of a backend; `reference` is the free motion on the backend with which it is compared."""
    freely, pressed = (move(name, q, **BACKENDS[name]) for q in (free, pressing))
    return {
        f"{MOTIONS} motions in free space, 2 s: largest difference of a joint from `{REFERENCE}`, mrad": 1e3
        * np.abs(freely.q - reference.q).max(),
        f"largest difference of a torque from `{REFERENCE}` when the arm rests, Nm": np.abs(
            freely.torque - reference.torque
        ).max(),
        "distance from the target at rest, rad": np.abs(freely.q[-1] - free).max(),
        f"{MOTIONS} motions into an obstacle at full speed: deepest contact, mm": 1e3
        * pressed.depth.max(),
        "deepest contact while the motors keep pressing, mm": 1e3 * pressed.depth[-1].max(),
    }


def main() -> None:
    """Print the table."""
    targets = uniform_q(robot(), CANDIDATES, seed=0, furthest=2.0)
    depth = move(REFERENCE, targets).depth
    free = targets[(depth == 0.0).all(axis=0)][:MOTIONS]
    pressing = targets[depth[-1] > 0.0][:MOTIONS]
    if min(len(free), len(pressing)) < MOTIONS:
        raise SystemExit(f"{len(free)} motions are free, {len(pressing)} end in contact: draw more")
    reference = move(REFERENCE, free)
    columns = [differences(name, free, pressing, reference) for name in BACKENDS]
    print("Versions:", ", ".join(f"{name} {version(name)}" for name in PACKAGES) + ".\n")
    row("", *(f"`{name}`" for name in BACKENDS))
    row(*["---"] * (1 + len(BACKENDS)))
    for text in columns[0]:
        row(text, *(f"{column[text]:.2g}" for column in columns))
    speed = float(robot().velocity_limit.max())
    behind = np.abs(move("pinocchio", free, max_joint_velocity=speed).q - reference.q)
    print(
        f"\nFree motions on `{REFERENCE}` and those of kinematic joints at {speed:.2f} rad/s differ by at most "
        f"{behind.max():.3f} rad on the way, and by {behind[-1].max():.0e} rad at the end."
    )


if __name__ == "__main__":
    main()
