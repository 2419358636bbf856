"""``python -m tests.reproduction``: the tables and claims of the thesis."""

from tests.tools.command_line import run

if __name__ == "__main__":
    run("tests.reproduction", "tests.reproduction.command:reproduce")
