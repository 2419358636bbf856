"""Exceptions of all packages, with the exit code of each, and of commands that find something."""

FOUND = 4
"""Exit code: done, and the answer is a finding, a change, or a missing part."""


class ArmidentError(Exception):
    """Base of all errors with a message for the user: one line that names the problem and its place."""

    exit_code = 1


class MotionStopped(ArmidentError):
    """A guard stopped a motion; the message says why. The arm must not move again before somebody has looked."""


class ConfigError(ArmidentError):
    """Error of usage or configuration; the message names the file, the key and the expected value."""

    exit_code = 2


class DataError(ArmidentError):
    """Error of data that cannot support the request; the message gives the reason."""

    exit_code = 3
