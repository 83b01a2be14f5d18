"""The errors of a lake, with messages for its user."""

from tracklake.schemas.errors import TracklakeError


class LakeError(TracklakeError):
    """A lake cannot be used as asked; the message says why and what to do."""


class LakeMissingError(LakeError):
    """There is no lake where one was named."""


class LakeLockedError(LakeError):
    """Another process is writing to the lake."""


class DamagedFileError(LakeError):
    """A live file's content is not what was written."""


class LakeVersionError(LakeError):
    """The lake was built by another version of the tables."""


class QueryError(LakeError):
    """A SQL statement was refused or failed."""
