"""The exceptions every room shares, and the exit code each one stands for."""


class ArmidentError(Exception):
    """An error with a message meant for the user: one line that says what and where."""

    exit_code = 1


class ConfigError(ArmidentError):
    """Usage or configuration is wrong; the message names the file, the key and what was expected."""

    exit_code = 2


class DataError(ArmidentError):
    """The data cannot support the request; the message says why."""

    exit_code = 3
