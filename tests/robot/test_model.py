"""RobotModel: what it reads from a URDF and an SRDF, and what it refuses."""

from __future__ import annotations

import gc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.testing import COPIES, pickled, uniform_q
from tests.helpers import joint_xml, robot_model, urdf_xml, write


def _load(tmp_path: Path, text: str, ee_frame: str | None = "link2") -> RobotModel:
    return RobotModel.load(write(tmp_path / "stick.urdf", text), ee_frame)


def test_a_urdf_of_ones_own_loads_from_its_path(tmp_path: Path) -> None:
    robot = _load(tmp_path, urdf_xml(joint_xml(0), joint_xml(1, "prismatic", "0 1 0")))
    assert robot.name == "stick"
    assert robot.joint_names == ("joint0", "joint1")
    assert robot.ee_frame == "link2"
    np.testing.assert_array_equal(robot.lower, [-2.0, -2.0])
    np.testing.assert_array_equal(robot.upper, [1.5, 1.5])
    np.testing.assert_array_equal(robot.velocity_limit, [2.0, 2.0])
    np.testing.assert_array_equal(robot.effort_limit, [10.0, 10.0])
    np.testing.assert_array_equal(robot.home, [0.0, 0.0])


def test_a_path_may_be_a_string(tmp_path: Path) -> None:
    urdf = write(tmp_path / "stick.urdf", urdf_xml(joint_xml(0)))
    assert RobotModel.load(str(urdf), "link1").urdf == urdf


def test_a_model_loads_as_itself(mara: RobotModel) -> None:
    assert RobotModel.load(mara) is mara


def test_a_robot_that_is_dropped_leaves_nothing_of_pinocchio() -> None:
    def geometries() -> int:
        gc.collect()
        return sum(type(each).__name__ == "GeometryModel" for each in gc.get_objects())

    RobotModel.load("mara")
    before = geometries()
    for _ in range(3):
        RobotModel.load("mara")
    assert geometries() == before


def test_home_is_the_nearest_to_zero_within_the_limits(tmp_path: Path) -> None:
    limit = '<limit lower="0.5" upper="1" effort="1" velocity="1"/>'
    robot = _load(tmp_path, urdf_xml(joint_xml(0), joint_xml(1, limit=limit)))
    np.testing.assert_array_equal(robot.home, [0.0, 0.5])


@pytest.mark.parametrize(
    ("kind", "value", "home"),
    [
        ("revolute", 7.0, 7.0 - 2 * np.pi),
        ("revolute", -6.0, 2 * np.pi - 6.0),
        ("revolute", 12.0, 12.0 - 4 * np.pi),
        ("revolute", 1.5005, 1.5),  # rounded
        ("continuous", 4.0, 4.0 - 2 * np.pi),
        ("continuous", 3.1416, np.pi),
    ],
)
def test_whole_turns_bring_a_home_pose_within_the_limits(
    tmp_path: Path, kind: str, value: float, home: float
) -> None:
    pose = f'<group_state name="rest"><joint name="joint0" value="{value}"/></group_state>'
    write(tmp_path / "stick.srdf", f'<robot name="stick">{pose}</robot>')
    robot = _load(tmp_path, urdf_xml(joint_xml(0, kind)), "link1")  # a test fails by a warning
    np.testing.assert_allclose(robot.home, [home], atol=1e-12)


def test_no_turn_is_added_to_a_prismatic_joint(tmp_path: Path) -> None:
    pose = '<group_state name="rest"><joint name="joint0" value="7"/></group_state>'
    write(tmp_path / "stick.srdf", f'<robot name="stick">{pose}</robot>')
    with pytest.warns(UserWarning, match="joint joint0: the SRDF's pose 'rest' puts it beyond"):
        robot = _load(tmp_path, urdf_xml(joint_xml(0, "prismatic")), "link1")
    np.testing.assert_array_equal(robot.home, [1.5])


def test_a_continuous_joint_turns_between_minus_pi_and_pi(tmp_path: Path) -> None:
    robot = _load(tmp_path, urdf_xml(joint_xml(0, "continuous"), joint_xml(1)))
    assert (robot.lower[0], robot.upper[0]) == (-np.pi, np.pi)
    np.testing.assert_array_equal(robot.velocity_limit, [2.0, 2.0])


def test_a_continuous_joint_needs_no_limit(tmp_path: Path) -> None:
    robot = _load(tmp_path, urdf_xml(joint_xml(0, "continuous", limit=""), joint_xml(1)))
    assert (robot.lower[0], robot.upper[0]) == (-np.pi, np.pi)


def test_links_off_the_chain_collide(tmp_path: Path) -> None:
    for mimic in ("", '<mimic joint="joint1"/>'):
        finger = joint_xml(2, "prismatic", extra=mimic)
        robot = _load(tmp_path, urdf_xml(joint_xml(0), joint_xml(1), finger))
        assert robot.joint_names == ("joint0", "joint1")
        assert any("link3" in pair for pair in robot.collision_pairs)


def test_an_srdf_beside_the_urdf_says_pose_end_effector_and_pairs(tmp_path: Path) -> None:
    write(
        tmp_path / "stick.srdf",
        """<robot name="stick">
          <group_state name="partly" group="arm"><joint name="joint0" value="9"/></group_state>
          <group_state name="rest" group="arm">
            <joint name="joint0" value="0.25"/><joint name="joint1" value="2"/>
          </group_state>
          <end_effector name="hand" parent_link="link2" group="arm"/>
          <disable_collisions link1="link2" link2="link0"/>
        </robot>""",
    )
    with pytest.warns(UserWarning, match="joint joint1: the SRDF's pose 'rest' puts it beyond"):
        robot = _load(tmp_path, urdf_xml(*map(joint_xml, range(3))), None)
    assert robot.ee_frame == "link2"
    np.testing.assert_array_equal(robot.home, [0.25, 1.5])
    # link3 hangs behind the end effector, locked to link2; link2 and link0 are disabled, the rest are neighbours.
    assert robot.collision_pairs == {frozenset({"link0", "link3"}), frozenset({"link1", "link3"})}


def test_without_an_srdf_neighbours_do_not_collide(tmp_path: Path) -> None:
    robot = _load(tmp_path, urdf_xml(*map(joint_xml, range(3))), "link3")
    assert robot.collision_pairs == {
        frozenset({"link0", "link2"}),
        frozenset({"link0", "link3"}),
        frozenset({"link1", "link3"}),
    }


def test_without_an_srdf_links_that_touch_at_home_do_not_collide(tmp_path: Path) -> None:
    back = joint_xml(1).replace('xyz="0.3 0 0.2" rpy="0.4 -0.3 0.2"', 'xyz="-0.3 0 -0.2"')
    forth = joint_xml(0).replace('rpy="0.4 -0.3 0.2"', "")
    aside = joint_xml(2).replace('xyz="0.3 0 0.2"', 'xyz="0 0.5 0"')
    with pytest.warns(UserWarning, match="links link0 and link2: they touch in the start pose"):
        robot = _load(tmp_path, urdf_xml(forth, back, aside), "link3")
    assert frozenset({"link0", "link2"}) not in robot.collision_pairs
    assert frozenset({"link1", "link3"}) in robot.collision_pairs


def test_what_of_mara_may_collide(mara: RobotModel) -> None:
    def may(a: str, b: str) -> bool:
        return frozenset({a, b}) in mara.collision_pairs

    assert may("table", "motor6_link")
    assert may("motor1_link", "motor6_link")
    assert may("base_robot", "motor4_link")
    assert not may("table", "base_robot"), "the base stands on the table"
    assert not may("table", "base_plate")
    assert not may("motor3_link", "motor4_link"), "one joint joins them"


def test_arrays_are_read_only(mara: RobotModel) -> None:
    for array in (mara.lower, mara.upper, mara.velocity_limit, mara.effort_limit, mara.home):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


@pytest.mark.parametrize("duplicate", COPIES)
@pytest.mark.parametrize("name", ["mara", "panda"])
def test_a_copy_is_the_same_robot(name: str, duplicate: Callable[[RobotModel], RobotModel]) -> None:
    robot = robot_model(name)
    other = duplicate(robot)
    assert repr(other) == repr(robot)
    assert other.collision_pairs == robot.collision_pairs
    np.testing.assert_array_equal(other.home, robot.home)


@given(st.integers(0, 2**32 - 1), st.sampled_from(["mara", "panda_collision", "ur5"]))
def test_reach_and_extent_bound_every_point_of_the_arm(seed: int, name: str) -> None:
    robot = robot_model(name)
    before, after = uniform_q(robot, 2, seed)
    corners = []
    for q in (before, after):
        data, geometry_data = robot.model.createData(), robot.geometry.createData()
        pin.updateGeometryPlacements(robot.model, data, robot.geometry, geometry_data, q)
        placed = []
        for number, thing in enumerate(robot.geometry.geometryObjects):
            if thing.parentJoint:
                thing.geometry.computeLocalAABB()
                box = thing.geometry.aabb_local
                ends = np.stack([box.min_, box.max_])
                placed += [
                    geometry_data.oMg[number].act(ends[[i, j, k], [0, 1, 2]])
                    for i in (0, 1)
                    for j in (0, 1)
                    for k in (0, 1)
                ]
        placed.append(robot.kinematics().pose(q[None])[0][0])
        corners.append(np.array(placed))
    travel = np.linalg.norm(corners[1] - corners[0], axis=1).max()
    assert travel <= robot.reach @ np.abs(after - before) + 1e-9
    assert np.linalg.norm(corners, axis=2).max() <= robot.extent + 1e-9


def test_reach_of_a_sliding_joint_is_its_own_travel(tmp_path: Path) -> None:
    robot = _load(tmp_path, urdf_xml(joint_xml(0, "prismatic"), joint_xml(1)))
    assert robot.reach[0] == 1.0


@pytest.mark.parametrize(
    ("q", "message"),
    [
        ([0.0] * 5, r"start_q has shape \(5,\); mara needs \(6,\)"),
        (
            [0, 2.36, 0, 0, 0, 0],
            r"joint motor2 cannot be at 2\.36; its limits are \[-2\.35, 2\.35\]",
        ),
        ([0, 0, 0, 0, 0, np.nan], r"must be a list of finite numbers"),
    ],
)
def test_a_configuration_is_checked(mara: RobotModel, q: list[float], message: str) -> None:
    with pytest.raises(GymMaraError, match=message):
        mara.checked_q(q, "start_q")


def test_a_missing_urdf(tmp_path: Path) -> None:
    with pytest.raises(GymMaraError, match=r"cannot read .*none\.urdf.*no such file"):
        RobotModel.load(tmp_path / "none.urdf", "link1")


@pytest.mark.parametrize(
    ("text", "ee_frame", "message"),
    [
        pytest.param("<robot><link", "link2", "is broken XML", id="broken XML"),
        pytest.param("", "link2", "is broken XML", id="empty"),
        pytest.param("<sdf/>", "link2", "root is <sdf>, not <robot>", id="not a robot"),
        pytest.param(
            urdf_xml(joint_xml(0), joint_xml(1)),
            "hand",
            "has no link 'hand'.*it has: link0, link1, link2",
            id="no such frame",
        ),
        pytest.param(
            urdf_xml(joint_xml(0), joint_xml(1)),
            None,
            "name the end-effector link.*ee_frame=.*link0, link1, link2",
            id="frame not named",
        ),
        pytest.param(
            urdf_xml(joint_xml(0, "floating"), joint_xml(1)),
            "link2",
            "not a fixed-base chain to 'link2': joint 'joint0' is floating",
            id="floating",
        ),
        pytest.param(
            urdf_xml(joint_xml(0, "planar"), joint_xml(1)),
            "link2",
            "joint 'joint0' is planar",
            id="planar",
        ),
        pytest.param(
            urdf_xml(joint_xml(0), joint_xml(1, extra='<mimic joint="joint0"/>')),
            "link2",
            "joint 'joint1', which leads to 'link2', mimics 'joint0'; only joints off the chain may",
            id="mimic",
        ),
        pytest.param(
            urdf_xml(joint_xml(0, "fixed"), joint_xml(1)),
            "link1",
            "no moving joint leads to 'link1'",
            id="no joint",
        ),
        pytest.param(
            urdf_xml(joint_xml(0).replace('<parent link="link0"/>', ""), joint_xml(1)),
            "link2",
            "joint 'joint0' has no <parent>",
            id="joint without parent",
        ),
        pytest.param(
            urdf_xml(joint_xml(0, limit=""), joint_xml(1)),
            "link2",
            r"stick\.urdf.*joint 'joint0' is revolute and has no <limit>",
            id="no limit",
        ),
    ],
)
def test_a_urdf_that_is_no_arm(
    tmp_path: Path, text: str, ee_frame: str | None, message: str
) -> None:
    with pytest.raises(GymMaraError, match=message):
        _load(tmp_path, text, ee_frame)


def test_a_missing_mesh_is_named(tmp_path: Path) -> None:
    text = urdf_xml(joint_xml(0)).replace('<sphere radius="0.05"/>', '<mesh filename="gone.stl"/>')
    with pytest.raises(
        GymMaraError,
        match=r"the mesh 'gone.stl' .* is not found; it was looked for at .*package_dirs",
    ):
        _load(tmp_path, text, "link1")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        pytest.param("<robot", "the SRDF .* is broken XML", id="broken XML"),
        pytest.param(
            '<disable_collisions link1="link0"/>',
            "<disable_collisions> without 'link2'",
            id="half a pair",
        ),
        pytest.param(
            '<group_state name="rest"><joint name="joint0"/></group_state>',
            "<joint> without 'value': <joint name=\"joint0\"",
            id="no value",
        ),
        pytest.param(
            '<group_state name="rest"><joint value="0"/></group_state>',
            "<joint> without 'name'",
            id="no joint",
        ),
        pytest.param(
            '<group_state><joint name="joint0" value="0"/></group_state>',
            "<group_state> without 'name'",
            id="no name of the pose",
        ),
        pytest.param(
            '<group_state name="rest"><joint name="joint0" value="1,5"/></group_state>',
            "puts joint 'joint0' at '1,5'; .* a finite number",
            id="no number",
        ),
        pytest.param(
            '<group_state name="rest"><joint name="joint0" value="nan"/></group_state>',
            "puts joint 'joint0' at 'nan'",
            id="not finite",
        ),
        pytest.param(
            '<group_state name="rest"><joint name="joint0" value="1 2"/></group_state>',
            "pose 'rest' gives joint 'joint0' 2 values",
            id="several values",
        ),
        pytest.param('<end_effector name="hand"/>', "without 'parent_link'", id="no parent link"),
    ],
)
def test_a_faulty_srdf_is_an_error(tmp_path: Path, content: str, message: str) -> None:
    text = content if content == "<robot" else f'<robot name="stick">{content}</robot>'
    write(tmp_path / "stick.srdf", text)
    with pytest.raises(GymMaraError, match=message):
        _load(tmp_path, urdf_xml(joint_xml(0)), "link1")


def test_a_pose_may_name_joints_that_are_locked_or_of_several_degrees_of_freedom(
    tmp_path: Path,
) -> None:
    state = """<group_state name="rest"><joint name="joint0" value="0.5"/>
        <joint name="joint1" value="1"/><joint name="joint2" value="1 2 3"/></group_state>"""
    write(tmp_path / "stick.srdf", f'<robot name="stick">{state}</robot>')
    joints = joint_xml(0), joint_xml(1), joint_xml(2, "floating")
    np.testing.assert_array_equal(_load(tmp_path, urdf_xml(*joints), "link1").home, [0.5])


def test_the_first_pose_in_the_file_is_home_also_where_names_repeat(tmp_path: Path) -> None:
    poses = ("b", 0.5), ("a", 0.25), ("b", 1.0)
    states = "".join(
        f'<group_state name="{name}" group="g"><joint name="joint0" value="{value}"/></group_state>'
        for name, value in poses
    )
    write(tmp_path / "stick.srdf", f'<robot name="stick">{states}</robot>')
    np.testing.assert_array_equal(_load(tmp_path, urdf_xml(joint_xml(0)), "link1").home, [0.5])


def test_names_in_the_srdf_that_the_urdf_lacks_bring_one_warning(tmp_path: Path) -> None:
    content = '<disable_collisions link1="link0" link2="lnik2"/>'
    content += '<group_state name="rest"><joint name="jiont0" value="1"/></group_state>'
    write(tmp_path / "stick.srdf", f'<robot name="stick">{content}</robot>')
    with pytest.warns(UserWarning, match="lacks: jiont0, lnik2; .* ignored. Correct them"):
        robot = _load(tmp_path, urdf_xml(joint_xml(0), joint_xml(1)))
    assert pickled(robot).collision_pairs == robot.collision_pairs


def test_a_locked_joint_may_be_named_like_a_link_and_lack_limits(tmp_path: Path) -> None:
    finger = joint_xml(2, limit="").replace('name="joint2"', 'name="link3"')
    robot = _load(tmp_path, urdf_xml(joint_xml(0), joint_xml(1), finger))
    assert robot.joint_names == ("joint0", "joint1")
