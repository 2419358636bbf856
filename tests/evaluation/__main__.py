"""``python -m tests.evaluation``: the diagnosis suites."""

from tests.tools.command_line import run

if __name__ == "__main__":
    run("tests.evaluation", "tests.evaluation.command:suite")
