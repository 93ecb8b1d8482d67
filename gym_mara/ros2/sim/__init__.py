"""A simulated arm behind the topics of ros2_control."""
