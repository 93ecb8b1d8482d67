"""Joints off the chain are locked within their limits, or follow the joint of the chain that they mimic."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from gym_mara.backends.pinocchio import PinocchioBackend
from gym_mara.collision import make_checker
from gym_mara.collision.coal import approach_bounds
from gym_mara.errors import GymMaraError
from gym_mara.rendering.scene import Scene
from gym_mara.rendering.view import View
from gym_mara.robot import RobotModel
from gym_mara.robot.fingerprint import fingerprint
from tests.helpers import Floats, upright_arm, write

FINGER = """
<link name="finger"><collision><geometry><box size="0.01 0.01 0.05"/></geometry></collision></link>
<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="finger"/>
  <origin xyz="-0.1 0.02 0.05" rpy="0.3 -0.2 0.5"/><axis xyz="{axis}"/>{limit}{extra}</joint>"""
LIMIT = '<limit lower="{}" upper="{}" effort="1" velocity="1"/>'
BAR = """
<link name="bar"><collision><origin xyz="0 0 0.15"/><geometry><box size="0.02 0.02 0.2"/></geometry></collision></link>
<joint name="{name}" type="revolute"><parent link="l1"/><child link="bar"/><origin xyz="-0.1 0 0.3"/><axis xyz="0 1 0"/>
  {limit}<mimic joint="j2"/></joint>"""


def _finger(
    kind: str = "prismatic",
    limit: str = "",
    axis: str = "1 2 3",
    extra: str = "",
    name: str = "jf",
    parent: str = "tool",
) -> str:
    return FINGER.format(kind=kind, limit=limit, axis=axis, extra=extra, name=name, parent=parent)


def _load(folder: Path, extra: str, pose: dict[str, float] | None = None) -> RobotModel:
    """The arm with more elements, and with an SRDF with one pose if it is given."""
    if pose is not None:
        joints = "".join(f'<joint name="{name}" value="{at}"/>' for name, at in pose.items())
        state = f'<group_state name="home" group="arm">{joints}</group_state>'
        write(folder / "arm.srdf", f'<robot name="upright">{state}</robot>')
    return RobotModel.load(write(folder / "arm.urdf", upright_arm(extra)), "tool")


def _expected(text: str, positions: dict[str, float], link: str) -> Floats:
    """The pose of a link (4, 4) with all joints of a URDF moving, its mimic joints at the given positions, too."""
    model = pin.buildModelFromXML(text)
    q, data = pin.neutral(model), model.createData()
    for name, position in positions.items():
        joint = model.joints[model.getJointId(name)]
        if joint.nq == 2:  # continuous
            q[joint.idx_q : joint.idx_q + 2] = np.cos(position), np.sin(position)
        else:
            q[joint.idx_q] = position
    pin.framesForwardKinematics(model, data, q)
    return np.array(data.oMf[model.getFrameId(link, pin.FrameType.BODY)].homogeneous)


def _pose(robot: RobotModel, q: Floats, link: str) -> Floats:
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    return np.array(data.oMf[robot.model.getFrameId(link, pin.FrameType.BODY)].homogeneous)


Q = np.array([0.3, -0.4, 0.5])
AT_Q = {"j1": 0.3, "j2": -0.4, "j3": 0.5}
HOME = {"j1": 0.0, "j2": 0.0, "j3": 0.0}


@pytest.mark.parametrize("kind", ["prismatic", "revolute", "continuous"])
@pytest.mark.parametrize(
    ("limits", "pose", "locked"),
    [
        ((0.02, 0.04), None, 0.02),
        ((-0.04, -0.02), None, -0.02),
        ((0.02, 0.04), HOME | {"jf": 0.03}, 0.03),
        ((0.02, 0.04), HOME | {"jf": 3.0}, 0.04),
        ((0.02, 0.04), {"jf": 0.03}, 0.02),  # no home pose: it does not name the arm's joints
        ((-1.0, 1.0), HOME | {"jf": -0.7}, -0.7),
    ],
)
def test_a_joint_off_the_chain_is_locked_within_its_limits_at_the_home_pose(
    tmp_path: Path,
    kind: str,
    limits: tuple[float, float],
    pose: dict[str, float] | None,
    locked: float,
) -> None:
    if kind == "continuous":
        limits, locked = (-9.0, 9.0), (pose or {}).get("jf", 0.0) * ("j1" in (pose or {}))
    extra = _finger(kind, LIMIT.format(*limits))
    robot = _load(tmp_path, extra, pose)
    assert robot.joint_names == ("j1", "j2", "j3")
    expected = _expected(upright_arm(extra), AT_Q | {"jf": locked}, "finger")
    np.testing.assert_allclose(_pose(robot, Q, "finger"), expected, atol=1e-14)


def test_whole_turns_bring_a_locked_joint_within_its_limits(tmp_path: Path) -> None:
    extra = _finger("revolute", LIMIT.format(-1.0, 1.0))
    robot = _load(tmp_path, extra, HOME | {"jf": 6.0})
    expected = _expected(upright_arm(extra), AT_Q | {"jf": 6.0}, "finger")
    np.testing.assert_allclose(_pose(robot, Q, "finger"), expected, atol=1e-14)


def test_at_zero_nothing_is_rounded(tmp_path: Path) -> None:
    extra = _finger("revolute", LIMIT.format(-1, 1))
    fixed = _load(tmp_path, _finger("fixed"))
    np.testing.assert_array_equal(
        _pose(_load(tmp_path, extra), Q, "finger"), _pose(fixed, Q, "finger")
    )


def test_a_locked_joint_needs_no_complete_limit_but_one_in_order(tmp_path: Path) -> None:
    for limit in ("", '<limit effort="1"/>'):
        assert _load(tmp_path, _finger("revolute", limit)).num_joints == 3
    with pytest.raises(GymMaraError, match="joint 'jf' has the lower limit 2, above its upper"):
        _load(tmp_path, _finger("revolute", LIMIT.format(2, 1)))


@pytest.mark.parametrize("name", ["jf", "a"])  # the parser sorts joints by name
@pytest.mark.parametrize("kind", ["prismatic", "revolute", "continuous"])
@pytest.mark.parametrize("parent", ["base", "l1", "tool"])
def test_a_joint_that_mimics_one_of_the_chain_follows_it(
    tmp_path: Path, name: str, kind: str, parent: str
) -> None:
    extra = _finger(
        kind,
        LIMIT.format(-9, 9),
        extra='<mimic joint="j2" multiplier="-1.5" offset="0.2"/>',
        name=name,
        parent=parent,
    )
    robot = _load(tmp_path, extra)
    assert robot.joint_names == ("j1", "j2", "j3")
    assert robot.followers == ((name, 1, -1.5, 0.2),)
    assert list(robot.model.names)[1:] == ["j1", "j2", "j3", name]
    position = -1.5 * AT_Q["j2"] + 0.2
    expected = _expected(upright_arm(extra), AT_Q | {name: position}, "finger")
    np.testing.assert_allclose(_pose(robot, Q, "finger"), expected, atol=1e-14)
    batch = np.random.default_rng(0).uniform(-2, 2, (50, 3))
    few, many = robot.kinematics().pose(batch[:5]), robot.kinematics().pose(batch)
    for one, other in zip(few, many, strict=True):
        np.testing.assert_allclose(one, other[:5], atol=1e-12)


def test_a_mimic_of_a_mimic_follows_and_one_of_a_locked_joint_is_locked(tmp_path: Path) -> None:
    other = _finger(
        "revolute", extra='<mimic joint="jf" multiplier="2" offset="0.1"/>', name="jg"
    ).replace("finger", "thumb")
    following = _finger("revolute", extra='<mimic joint="j3" multiplier="-1" offset="0.2"/>')
    robot = _load(tmp_path, other + following)
    assert {tuple(each) for each in robot.followers} == {
        ("jf", 2, -1.0, 0.2),
        ("jg", 2, -2.0, 0.5),
    }
    locked = _finger("revolute", LIMIT.format(0.3, 1))
    robot = _load(tmp_path, other + locked)
    assert robot.followers == ()
    text = upright_arm(
        (other + locked).replace(
            '<axis xyz="1 2 3"/><mimic', f"<axis xyz='1 2 3'/>{LIMIT.format(-1, 1)}<mimic"
        )
    )
    expected = _expected(text, AT_Q | {"jg": 2 * 0.3 + 0.1}, "thumb")
    np.testing.assert_allclose(_pose(robot, Q, "thumb"), expected, atol=1e-14)


@pytest.mark.parametrize(
    ("mimic", "message"),
    [
        ('joint="x"', "joint 'jf' mimics 'x', which is no joint"),
        ('joint="jf"', "joint 'jf' mimics itself"),
        ('joint="j1" multiplier="a"', "<mimic> of joint 'jf' has multiplier='a'"),
        ('offset="1"', "<mimic> of joint 'jf' has no joint"),
    ],
)
def test_a_bad_mimic_joint_is_an_error(tmp_path: Path, mimic: str, message: str) -> None:
    with pytest.raises(GymMaraError, match=message):
        _load(tmp_path, _finger("revolute", extra=f"<mimic {mimic}/>"))


def test_a_joint_off_the_chain_needs_a_direction_to_move_in(tmp_path: Path) -> None:
    mimic = '<mimic joint="j1"/>'
    for finger in (_finger("revolute", extra=mimic), _finger("revolute", LIMIT.format(1, 2))):
        with pytest.raises(GymMaraError, match="the axis of joint 'jf' has length zero"):
            _load(tmp_path, finger.replace("1 2 3", "0 0 0"))
    assert _load(tmp_path, _finger("revolute", LIMIT.format(0, 2), "0 0 0")).num_joints == 3


@pytest.fixture
def with_bar(tmp_path: Path) -> RobotModel:
    return _load(tmp_path, BAR.format(name="bar", limit=LIMIT.format(-2, 2)))


def _free_bar_collides(q: Floats) -> list[bool]:
    """Which configurations (N, 3) collide, with the bar moved by hand as a fourth joint."""
    text = upright_arm(BAR.format(name="jb", limit=LIMIT.format(-2, 2)))
    model = pin.buildModelFromXML(text)
    geometry = pin.buildGeomFromUrdfString(model, text, pin.GeometryType.COLLISION)
    geometry.addAllCollisionPairs()
    data, geometry_data = model.createData(), geometry.createData()
    order = [("j1", "j2", "j3", "jb").index(name) for name in list(model.names)[1:]]
    joined = [("base", "l1"), ("l1", "l2"), ("l2", "l3"), ("l1", "bar")]
    for one, other in joined:
        pair = geometry.getGeometryId(f"{one}_0"), geometry.getGeometryId(f"{other}_0")
        if geometry.existCollisionPair(pin.CollisionPair(*pair)):
            geometry.removeCollisionPair(pin.CollisionPair(*pair))
    geometry_data = geometry.createData()
    return [
        pin.computeCollisions(
            model, data, geometry, geometry_data, np.append(row, row[1])[order], True
        )
        for row in q
    ]


def test_collisions_move_with_the_bar(with_bar: RobotModel) -> None:
    q = np.random.default_rng(0).uniform(-2, 2, (500, 3))
    expected = _free_bar_collides(q)
    assert 100 < sum(expected) < 400
    for engine in ("coal", "fcl"):
        np.testing.assert_array_equal(make_checker(engine, with_bar).check(q), expected)
    backend = PinocchioBackend(with_bar, len(q))
    backend.reset(q)
    np.testing.assert_array_equal(backend.step(q).collided, expected)


def test_bounds_count_what_follows(with_bar: RobotModel) -> None:
    random = np.random.default_rng(1)
    model, geometry = with_bar.model, with_bar.geometry
    data, geometry_data = model.createData(), geometry.createData()

    def look(q: Floats) -> tuple[Floats, Floats]:
        """The shapes' positions and the pairs' distances."""
        pin.updateGeometryPlacements(model, data, geometry, geometry_data, q)
        pin.computeDistances(geometry, geometry_data)
        places = np.array([placement.translation for placement in geometry_data.oMg])
        return places, np.array([r.min_distance for r in geometry_data.distanceResults])

    for _ in range(200):
        q, step = random.uniform(-1, 1, 3), random.uniform(-0.5, 0.5, 3)
        places, distances = look(q)
        moved, after = look(q + step)
        travel = np.linalg.norm(moved - places, axis=1).max()
        assert travel <= with_bar.reach @ np.abs(step) + 1e-9
        shrunk = np.maximum(distances, 0.0) - np.maximum(after, 0.0)
        assert (shrunk <= approach_bounds(with_bar, np.abs(step)) + 1e-6).all()
        assert np.linalg.norm(moved, axis=1).max() <= with_bar.extent


def test_pictures_show_the_bar_where_it_is(with_bar: RobotModel) -> None:
    scene = Scene(with_bar)
    index = next(index for index, part in enumerate(scene.parts) if part.link == "bar")
    view = View(Q, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    text = upright_arm(BAR.format(name="jb", limit=LIMIT.format(-2, 2)))
    link = _expected(text, AT_Q | {"jb": AT_Q["j2"]}, "bar")
    box = pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.15])).homogeneous
    np.testing.assert_allclose(scene.placements(view)[index], link @ box, atol=1e-14)


def test_copies_and_fingerprints_know_the_bar(with_bar: RobotModel, tmp_path: Path) -> None:
    copied = pickle.loads(pickle.dumps(with_bar))
    assert copied.followers == with_bar.followers
    assert fingerprint(copied) == fingerprint(with_bar)
    other = BAR.format(name="bar", limit=LIMIT.format(-2, 2)).replace('"j2"/>', '"j2" offset="1"/>')
    moved = RobotModel.inspect(write(tmp_path / "arm.urdf", upright_arm(other)), "tool")
    assert fingerprint(moved) != fingerprint(with_bar)
