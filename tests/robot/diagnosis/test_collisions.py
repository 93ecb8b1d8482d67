"""Findings about collisions, and the SRDF that is written for them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gym_mara.robot import RobotModel
from gym_mara.robot.collision_pairs import AT_HOME, DISABLED, NEIGHBOURS, touching_pairs
from gym_mara.robot.diagnosis import sampling
from gym_mara.robot.diagnosis.collisions import pair_names
from gym_mara.robot.diagnosis.sampling import Poses
from gym_mara.robot.diagnosis.srdf_writer import disabled_pairs, srdf_text
from tests.helpers import robot_model, write
from tests.robot.arms import BASE, COLLISION, FOLDED, TOOL, arm, arm_file


def _pair(one: str, other: str) -> frozenset[str]:
    return frozenset({one, other})


@pytest.mark.parametrize(
    ("base", "message"),
    [("", "no link has a collision shape"), (BASE, "no link that moves has a collision shape")],
)
def test_an_arm_that_never_collides_is_a_warning(tmp_path: Path, base: str, message: str) -> None:
    with pytest.warns(UserWarning, match=f"robot: {message}; no collision is ever found") as warned:
        RobotModel.load(arm_file(tmp_path, arm(collision="", base=base)), TOOL)
    assert len(warned) == 1


def test_an_arm_of_neighbours_is_a_note(tmp_path: Path) -> None:
    text = arm(base="").replace(COLLISION, "", 1)
    (finding,) = RobotModel.load(arm_file(tmp_path, text), TOOL).findings
    assert (finding.severity, finding.part) == ("note", "robot")


def test_pairs_that_touch_at_home_and_elsewhere_not_are_a_warning(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="links l1 and l3: they touch in the start pose, but not"):
        robot = RobotModel.load(arm_file(tmp_path, arm(origins=FOLDED)), TOOL)
    assert robot.excluded_pairs[_pair("l1", "l3")] == AT_HOME
    assert _pair("l1", "l3") not in robot.collision_pairs


def test_pairs_that_always_touch_are_a_note(tmp_path: Path) -> None:
    box = '<collision><geometry><box size="2 2 2"/></geometry></collision>'
    findings = RobotModel.load(arm_file(tmp_path, arm(collision=box, base="")), TOOL).findings
    assert [(finding.severity, finding.part) for finding in findings] == [
        ("note", "robot"),
        ("note", "links l1 and l3"),
    ]
    assert "in the start pose and in almost all others" in findings[1].message


def _often(tmp_path: Path) -> Path:
    """An arm of which l1 and l3 touch in most poses, but not at home, which an SRDF puts aside."""
    ball = (
        '<collision><origin xyz="0 0 0.1"/><geometry><sphere radius="0.3"/></geometry></collision>'
    )
    text = arm(base="", collision="", kind="revolute").replace(
        '<link name="l1">', f'<link name="l1">{ball}'
    )
    text = text.replace('<link name="l3">', f'<link name="l3">{ball}')
    text = text.replace('lower="-2" upper="2"', 'lower="-0.2" upper="1.2"')
    return arm_file(tmp_path, text.replace('xyz="0 0 0.3"', 'xyz="0 0 0.305"'))


def test_pairs_that_touch_in_most_poses_are_a_warning(tmp_path: Path) -> None:
    urdf = _often(tmp_path)
    with pytest.warns(UserWarning, match=r"links l1 and l3: .* % of random poses") as warned:
        RobotModel.load(urdf, TOOL)
    assert len(warned) == 1
    assert f"gym-mara robot arm.urdf --ee-frame {TOOL} --write-srdf arm.srdf" in str(warned[0])


def test_an_obstacle_that_is_often_hit_is_no_warning(tmp_path: Path) -> None:
    ceiling = (
        '<collision><origin xyz="0 0 1.5"/><geometry><box size="3 3 2"/></geometry></collision>'
    )
    srdf = '<group_state name="home" group="arm">' + "".join(
        f'<joint name="j{n}" value="{q}"/>' for n, q in ((1, 0), (2, 1.9), (3, 1.9))
    )
    urdf = arm_file(tmp_path, arm(base=ceiling), srdf + "</group_state>")
    robot = RobotModel.load(urdf, TOOL)
    counts = Poses(robot, robot.collision_pairs).count(
        sampling.random_configurations(robot, sampling.POSES)
    )
    assert counts[_pair("base", "l3")] > sampling.OFTEN * sampling.POSES
    assert robot.findings == ()


def test_the_shares_are_those_of_all_random_poses(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="random poses"):
        robot = RobotModel.load(_often(tmp_path), TOOL)
    q = sampling.random_configurations(robot, sampling.POSES)
    assert ((q >= robot.lower) & (q <= robot.upper)).all()
    hits = [_pair("l1", "l3") in touching_pairs(robot.model, robot.geometry, row) for row in q]
    assert sampling.often_touching(robot) == {_pair("l1", "l3"): np.mean(hits)}


def test_an_arm_that_is_loaded_again_is_not_sampled_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    urdf = arm_file(tmp_path)
    first = RobotModel.load(urdf, TOOL)
    monkeypatch.setattr(Poses, "count", None)
    assert RobotModel.load(urdf, TOOL).findings == first.findings


def test_an_srdf_that_disables_the_defaults_of_a_link(tmp_path: Path) -> None:
    srdf = '<disable_default_collisions link="l3"/><enable_collisions link1="l3" link2="base"/>'
    robot = RobotModel.load(arm_file(tmp_path, srdf=srdf), TOOL)
    assert robot.collision_pairs == {_pair("base", "l2"), _pair("base", "l3")}
    assert robot.excluded_pairs == {
        _pair("base", "l1"): NEIGHBOURS,
        _pair("l1", "l2"): NEIGHBOURS,
        _pair("l2", "l3"): DISABLED,
        _pair("l1", "l3"): DISABLED,
    }


def test_checked_pairs_that_touch_at_home_are_a_warning(tmp_path: Path) -> None:
    srdf = '<disable_collisions link1="base" link2="l2" reason="Never"/>'
    urdf = arm_file(tmp_path, arm(origins=FOLDED), srdf)
    with pytest.warns(
        UserWarning, match="links l1 and l3: .*every episode begins in a collision"
    ) as warned:
        robot = RobotModel.load(urdf, TOOL)
    assert len(warned) == 1
    assert _pair("l1", "l3") in robot.collision_pairs


def test_a_home_pose_beyond_the_limits_is_a_warning(tmp_path: Path) -> None:
    values = "".join(f'<joint name="j{n}" value="{q}"/>' for n, q in ((1, 0), (2, 2.0005), (3, -3)))
    srdf = f'<group_state name="up" group="arm">{values}</group_state>'
    with pytest.warns(UserWarning, match="joint j3: the SRDF's pose 'up' puts it beyond") as warned:
        robot = RobotModel.load(arm_file(tmp_path, srdf=srdf), TOOL)
    assert len(warned) == 1
    np.testing.assert_array_equal(robot.home, [0.0, 2.0, -2.0])


def test_a_finding_lists_a_few_pairs() -> None:
    pairs = [_pair("a", str(number)) for number in range(30)]
    assert pair_names(pairs) == "0 and a, 1 and a, 2 and a, 3 and a and 26 more"


@pytest.mark.parametrize(
    ("srdf", "message"),
    [
        ('<disable_collisions link1="a" link2="b"/>', "another robot: the URDF has 0 of the 2"),
        (
            '<disable_collisions link1="l1" link2="b"/><disable_collisions link1="c" link2="d"/>'
            '<disable_collisions link1="e" link2="f"/>',
            "another robot: the URDF has 1 of the 6 .* Give this robot's own SRDF",
        ),
        (
            '<disable_collisions link1="l1" link2="l3"/><disable_collisions link1="l1" link2="d"/>',
            "lacks: d; what the URDF lacks is ignored",
        ),
    ],
)
def test_an_srdf_of_another_robot_is_a_warning(tmp_path: Path, srdf: str, message: str) -> None:
    with pytest.warns(UserWarning, match=rf"SRDF .*arm\.srdf'.*{message}") as warned:
        RobotModel.load(arm_file(tmp_path, srdf=srdf), TOOL)
    assert len(warned) == 1


def test_an_srdf_of_another_robot_does_not_keep_links_that_touch_at_home(tmp_path: Path) -> None:
    urdf = arm_file(tmp_path, arm(origins=FOLDED), '<disable_collisions link1="a" link2="b"/>')
    robot = RobotModel.inspect(urdf, TOOL)
    assert robot.excluded_pairs[_pair("l1", "l3")] == AT_HOME


@pytest.mark.parametrize("origins", [None, FOLDED])
def test_a_written_srdf_disables_exactly_its_pairs(
    tmp_path: Path, origins: tuple[str, ...] | None
) -> None:
    urdf = arm_file(tmp_path, arm(origins=origins) if origins else None)
    robot = RobotModel.inspect(urdf, TOOL)
    disabled = disabled_pairs(robot)
    every = robot.collision_pairs | robot.excluded_pairs.keys()
    assert "Adjacent" in disabled.values()
    write(urdf.with_suffix(".srdf"), srdf_text(robot, disabled))
    read = RobotModel.load(urdf)
    assert read.ee_frame == robot.ee_frame
    np.testing.assert_array_equal(read.home, robot.home)
    assert read.excluded_pairs == dict.fromkeys(disabled, DISABLED)
    assert read.collision_pairs == every - disabled.keys()


def test_a_written_srdf_takes_the_warnings_away(tmp_path: Path) -> None:
    urdf = _often(tmp_path)
    robot = RobotModel.inspect(urdf, TOOL)
    disabled = disabled_pairs(robot)
    assert disabled[_pair("l1", "l3")] == "Often"
    write(urdf.with_suffix(".srdf"), srdf_text(robot, disabled))
    RobotModel.load(urdf)


def test_a_pair_is_never_disabled_if_it_touches_in_a_random_pose() -> None:
    robot = robot_model("mara")
    disabled = disabled_pairs(robot)
    never = {pair for pair, reason in disabled.items() if reason == "Never"}
    assert never
    assert frozenset({"table", "motor6_link"}) not in disabled
    poses = Poses(robot, never)
    assert not poses.count(np.random.default_rng(1).uniform(robot.lower, robot.upper, (500, 6)))
