"""Identification: the physical parameters of an arm, from a log of its motion."""

from gym_mara.identification.excitation import excitation
from gym_mara.identification.fit import identify
from gym_mara.identification.identified import Estimate, Identified
from gym_mara.identification.log import Log

__all__ = ["Estimate", "Identified", "Log", "excitation", "identify"]
