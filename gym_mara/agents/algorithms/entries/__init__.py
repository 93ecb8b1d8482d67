"""One file for each algorithm: its class, its presets and its search space, as data."""

import math

PAPER_NETWORK = {"net_arch": [64, 64], "log_std_init": -math.log(math.pi)}
"""The network of ROS2Learn (arXiv 1903.06282); its initial standard deviation of 1 rad is 1/π of an action's range.

ROS2Learn made an update every 2048 steps. The presets "paper" take them from eight arms at once, 256 each.
"""
