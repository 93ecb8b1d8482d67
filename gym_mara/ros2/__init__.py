"""ROS 2: an arm behind topics, the safety filter that every command passes, and the nodes around a policy or a backend."""
