"""The dynamic backend on MuJoCo."""
