"""What is wrong with a robot's description, found once when it is loaded: values that say what follows and what to do."""

from gym_mara.robot.diagnosis.bodies import body_findings
from gym_mara.robot.diagnosis.collisions import collision_findings
from gym_mara.robot.diagnosis.finding import Finding, Severity, raise_errors, warn
from gym_mara.robot.diagnosis.joints import joint_findings
from gym_mara.robot.diagnosis.semantics import semantics_findings
from gym_mara.robot.diagnosis.written import range_findings, written_joints

__all__ = [
    "Finding",
    "Severity",
    "body_findings",
    "collision_findings",
    "joint_findings",
    "raise_errors",
    "range_findings",
    "semantics_findings",
    "warn",
    "written_joints",
]
