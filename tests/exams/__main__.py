"""``python -m tests.exams``: public exams, each with the published figures beside ours."""

from tests.tools.command_line import run

if __name__ == "__main__":
    run("tests.exams", "tests.exams.command:exam")
