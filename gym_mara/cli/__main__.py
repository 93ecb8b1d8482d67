"""python -m gym_mara.cli."""

from gym_mara.cli import main

main()
