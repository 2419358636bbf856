"""Writes cases of the suite of random arms: ``python -m tests.evaluation.plants --help``."""

from tests.evaluation.plants.disk import main

if __name__ == "__main__":
    main()
