"""The arm behind ROS 2's topics."""
