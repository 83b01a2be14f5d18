"""The root of all errors that a user sees as a message."""


class TracklakeError(Exception):
    """Something the user can mend: the message says what, where, what was expected, what was found, and what to do.

    Commands print the message and exit with `exit_code`. Every other exception is a bug and keeps its traceback.
    """

    exit_code = 1


class UsageError(TracklakeError):
    """A command or function was called with arguments or settings that cannot work."""

    exit_code = 2


class MissingExtraError(TracklakeError):
    """A package is needed that only an extra of tracklake installs; the message names the extra."""
