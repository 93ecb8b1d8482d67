"""The robots that gym_mara ships, a folder each; installed as gym_mara.robots."""
