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


class StoreError(LakeError):
    """A lake's objects cannot be read or written where they are kept."""


class AlreadyStoredError(StoreError):
    """An object that was to be created is there already."""


class MissingObjectError(StoreError):
    """An object that was to be read is not there."""


class SwapConflictError(StoreError):
    """An object was changed by another writer since it was read."""


class DamagedShardError(LakeError):
    """A part of the manifest is missing or damaged."""
