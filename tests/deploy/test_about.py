"""The metadata of an exported policy are read back as they were written, and damaged ones are refused."""

from __future__ import annotations

import json
from typing import Any

import pytest

from gym_mara.deploy import About
from gym_mara.errors import GymMaraError
from tests.deploy.models import ABSOLUTE, FROM_TARGET, GROUPS, RELATIVE, TWIST, about

FORMS = [
    about(ABSOLUTE),
    about(RELATIVE, GROUPS),
    about(FROM_TARGET),
    about(TWIST),
]


@pytest.mark.parametrize("metadata", FORMS, ids=lambda a: f"{a.action.mode}-{a.action.reference}")
def test_what_is_written_is_read(metadata: About) -> None:
    assert About.from_json(metadata.to_json()) == metadata


def test_the_inputs_are_those_of_the_parts() -> None:
    assert about().inputs == {"observation": 5}
    assert about(observation=GROUPS).inputs == {"observation": 3, "desired_goal": 2}


def changed(path: str, value: Any) -> str:
    """The JSON of the metadata with another value at "a.b.c"; the value `...` removes it."""
    values = json.loads(about(RELATIVE).to_json())
    *parents, last = path.split(".")
    place = values
    for name in parents:
        place = place[int(name)] if name.isdigit() else place[name]
    if value is ...:
        del place[last]
    else:
        place[last] = value
    return json.dumps(values)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("format", 2, "have the format 2, and this version of gym_mara reads 1"),
        ("format", ..., "have the format None"),
        ("format", "1", "have the format '1'"),
        ("format", True, "format must be of the type int"),
        ("robot", ..., "the metadata: 'robot' is missing"),
        ("robot", None, "robot must be of the type Robot"),
        ("robot.colour", "red", "robot: 'colour' is unknown"),
        ("robot.joints", [], "do not fit together"),
        ("robot.joints", {}, r"robot.joints must be of the type tuple"),
        (
            "robot.joints.1.lower",
            "0",
            r"robot.joints\[1\].lower must be of the type float, not '0'",
        ),
        ("robot.joints.1.lower", True, "must be of the type float"),
        ("robot.joints.1.lower", 10**400, "must be of the type float"),
        ("robot.joints.1.lower", 9.0, "a lower bound is above the upper one"),
        ("robot.joints.1.travel", 0.0, "must be positive"),
        ("action.mode", "sideways", "unknown action mode 'sideways'"),
        ("action.mode", "absolute", "do not fit together"),
        ("action.mode", "cartesian", "do not fit together"),
        ("action.reference", "", "unknown reference of actions"),
        ("action.low", [-1.0], "do not fit together"),
        ("action.low", [2.0] * 3, "a lower bound is above"),
        ("action.steps", [0.1, -0.1, 0.1], "must not be negative"),
        ("control_period", 0, "must be positive"),
        ("target", 5, "target must be of the type str"),
        ("observation", [], "must have parts"),
        ("observation.0.size", 0, "must have parts"),
        ("observation.0.size", 3.0, "size must be of the type int"),
    ],
)
def test_a_wrong_value_is_an_error(path: str, value: Any, message: str) -> None:
    with pytest.raises(GymMaraError, match=message):
        About.from_json(changed(path, value))


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "null", "[" * 100_000, '{"format": NaN}', "{" + '"a":1,' * 3 + "}"]
)
def test_a_text_that_is_no_metadata_is_an_error(text: str) -> None:
    with pytest.raises(GymMaraError, match="the metadata"):
        About.from_json(text)


def test_infinity_is_refused() -> None:
    text = about().to_json().replace("0.02", "1e999")
    with pytest.raises(GymMaraError, match="control_period must be of the type float, not inf"):
        About.from_json(text)
