"""Writes cases of the suite of random arms: ``python -m armident.virtual_robot.random_arms --help``."""

from armident.virtual_robot.random_arms.disk import main

if __name__ == "__main__":
    main()
