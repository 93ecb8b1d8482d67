"""The parameters of a simulated arm that make it follow the motion of a real one best."""
