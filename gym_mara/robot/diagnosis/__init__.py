"""What is wrong with a robot's description, found once when it is loaded: values that say what follows and what to do."""

from gym_mara.robot.diagnosis.collisions import collision_findings
from gym_mara.robot.diagnosis.finding import Finding, Severity, raise_errors, warn
from gym_mara.robot.diagnosis.motion import motion_findings
from gym_mara.robot.diagnosis.semantics import semantics_findings

__all__ = [
    "Finding",
    "Severity",
    "collision_findings",
    "motion_findings",
    "raise_errors",
    "semantics_findings",
    "warn",
]
