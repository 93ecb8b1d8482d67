"""Arms composed of MARA's modules."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from gym_mara.envs import MaraEnv
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.robot.description.modules import MARA, MODULES
from gym_mara.testing import pickled, uniform_q
from tests.helpers import MODULAR_ARMS


def test_maras_own_modules_make_mara(mara: RobotModel) -> None:
    composed = RobotModel.from_modules(MARA)
    assert composed.name == "mara"
    assert composed.joint_names == mara.joint_names
    assert composed.collision_pairs == mara.collision_pairs
    for name in ("lower", "upper", "velocity_limit", "effort_limit", "home", "reach"):
        np.testing.assert_array_equal(getattr(composed, name), getattr(mara, name), err_msg=name)
    assert composed.extent == mara.extent
    q = uniform_q(mara, 20, seed=0)
    for mine, its in zip(composed.kinematics().pose(q), mara.kinematics().pose(q), strict=True):
        np.testing.assert_array_equal(mine, its)
    for mine, its in zip(composed.model.inertias, mara.model.inertias, strict=True):
        assert mine == its


@pytest.mark.parametrize("joints", MODULAR_ARMS)
def test_an_arm_has_as_many_joints_as_its_motors_turn_faces(joints: int) -> None:
    robot = RobotModel.load(MODULAR_ARMS[joints])
    assert robot.num_joints == joints
    assert (np.diff(robot.effort_limit) <= 0.0).all()


def test_the_page_says_how_many_joints_a_list_of_modules_makes() -> None:
    page = Path(__file__).resolve().parents[3] / "docs" / "add_a_robot.md"
    [(modules, joints)] = re.findall(r"--set 'robot=(\[.*\])' +# (\d) joints", page.read_text())
    assert RobotModel.load(json.loads(modules)).num_joints == int(joints)


def test_a_composed_arm_pickles() -> None:
    robot = RobotModel.from_modules(MODULAR_ARMS[4])
    again = pickled(robot)
    assert (again.modules, again.joint_names) == (robot.modules, robot.joint_names)


@given(st.lists(st.sampled_from(MARA[1:-1]), min_size=1, max_size=6))
def test_whatever_fits_is_an_arm_of_all_its_modules(between: list[str]) -> None:
    try:
        robot = RobotModel.from_modules(["base", *between, "tool"])
    except GymMaraError:
        assume(False)
    mara = RobotModel.load("mara")
    links = [mara.link_of(index) for index in range(mara.geometry.ngeoms)]
    of_arm = [links.count(MODULES[name].link) for name in ("base", *between, "tool")]
    assert robot.geometry.ngeoms == sum(of_arm) + links.count("table") + links.count("base_plate")
    masses = dict(zip(MARA, [inertia.mass for inertia in mara.model.inertias], strict=True))
    # Modules that nothing turns belong to the world, as the base does.
    expected = sum(masses[name] for name in ("base", *between, "tool"))
    _, (quaternion,) = robot.kinematics().pose(robot.home[None])
    np.testing.assert_allclose(quaternion[1:3], 0.0, atol=1e-12, err_msg="the tool points up")
    assert sum(inertia.mass for inertia in robot.model.inertias) == pytest.approx(expected)


@given(st.lists(st.sampled_from(MARA[1:-1]), min_size=1, max_size=6), st.integers(0, 2**16))
def test_neighbours_touch_at_the_joint_that_turns_them(between: list[str], seed: int) -> None:
    try:
        robot = RobotModel.from_modules(["base", *between, "tool"])
    except GymMaraError:
        assume(False)
    q = uniform_q(robot, 1, seed)[0]
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, q)
    geometry = robot.geometry.createData()
    pin.updateGeometryPlacements(robot.model, data, robot.geometry, geometry)
    of_joint: dict[int, list[int]] = {}
    for index, shape in enumerate(robot.geometry.geometryObjects):
        of_joint.setdefault(shape.parentJoint, []).append(index)
    for joint in range(1, robot.num_joints + 1):
        gaps = [
            _distance(robot, geometry, a, b) for a in of_joint[joint - 1] for b in of_joint[joint]
        ]
        # The covers between two modules are up to two centimetres thick.
        assert min(gaps) < 0.02, (between, joint)


def _distance(robot: RobotModel, data: pin.GeometryData, a: int, b: int) -> float:
    import coal

    objects = robot.geometry.geometryObjects
    poses = [coal.Transform3s(data.oMg[i].rotation, data.oMg[i].translation) for i in (a, b)]
    return float(
        coal.distance(
            objects[a].geometry,
            poses[0],
            objects[b].geometry,
            poses[1],
            coal.DistanceRequest(),
            coal.DistanceResult(),
        )
    )


@pytest.mark.parametrize(
    ("modules", "reason"),
    [
        (["base", "motor_big", "tool"], "Did you mean 'motor_"),
        (["motor_large", "tool"], "must begin with its only 'base'"),
        ([], "must begin with its only 'base'"),
        (["base", "motor_large", "tool"], "'tool' does not fit onto 'motor_large'.*along x: "),
        (["base", "tool"], "3 to 7 joints.*makes 0"),
        (["base", *["motor_small"] * 8, "tool"], "3 to 7 joints.*makes 9"),
    ],
)
def test_what_is_no_arm_is_refused(modules: list[str], reason: str) -> None:
    with pytest.raises(GymMaraError, match=reason):
        RobotModel.from_modules(modules)


def test_an_environment_of_modules_goes_through_its_spec() -> None:
    import gymnasium

    env = gymnasium.make("gym_mara/MARA-v0", robot=MODULAR_ARMS[3])
    assert env.spec is not None
    spec = gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json())
    again = gymnasium.make(spec)
    assert isinstance(again.unwrapped, MaraEnv)
    assert again.action_space.shape == (3,)
