"""Drives: the logs of one folder, with a bag that is a folder in it, under a name of their own."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath

from tracklake.pipeline.sources.csv import ARCHIVE_SUFFIX
from tracklake.pipeline.sources.source import Grouping, RawFile, Unit
from tracklake.pipeline.sources.v2v.recognition import BAGS, ROS2_PARTS
from tracklake.schemas.text import make_visible


def group(files: Sequence[RawFile]) -> Grouping:
    """Group logs into drives, one per folder; a ROS 2 bag counts as a file of the folder that holds the bag's folder.

    Where that folder has no other logs, the bag is a drive by itself. A drive has the name of its folder, or of the
    file that the user named; where folders in different places have the same name, their paths tell them apart.
    """
    usable, refusals = _split_packed(files)
    by_folder: dict[str, list[RawFile]] = {}
    for file in usable:
        by_folder.setdefault(file.folder, []).append(file)
    bags = {folder for folder, own in by_folder.items() if all(file.dialect in ROS2_PARTS for file in own)}
    drives: dict[str, list[RawFile]] = {}
    for folder, own in by_folder.items():
        above = str(PurePosixPath(folder).parent)
        is_part = folder in bags and above in by_folder and above not in bags
        drives.setdefault(above if is_part else folder, []).extend(own)
    names = _name_drives(drives)
    given = {file.recording for file in usable if file.recording}
    if given and len(drives) > 1:
        refusals.append(
            f"--recording {given.pop()}: names one drive, and SOURCE holds {len(drives)}: {', '.join(names.values())}. "
            "Give the folder of one of them."
        )
        return Grouping((), tuple(refusals))
    units = (Unit(_sort_files(own), given.copy().pop() if given else names[key]) for key, own in drives.items())
    return Grouping(tuple(units), tuple(refusals))


def _sort_files(files: Sequence[RawFile]) -> tuple[RawFile, ...]:
    return tuple(sorted(files, key=lambda file: file.name))


def _split_packed(files: Sequence[RawFile]) -> tuple[list[RawFile], list[str]]:
    """Split off the bags in archives, which cannot be read there, with messages about them."""
    packed = {file.name: file.path.name for file in files if file.member is not None and file.dialect in BAGS}
    refusals = [
        f"{name}: a bag in an archive, which is not read. Unpack {archive}." for name, archive in packed.items()
    ]
    return [file for file in files if file.name not in packed], refusals


def _name_drives(drives: Mapping[str, Sequence[RawFile]]) -> dict[str, str]:
    """Name each drive after its folder; of several with the same name, after the path below SOURCE, too."""
    short = {key: _name_folder(PurePosixPath(key), own) for key, own in drives.items()}
    times = Counter(name.casefold() for name in short.values())
    names: dict[str, str] = {}
    for key in sorted(drives):
        name = short[key]
        if times[name.casefold()] > 1:
            depth = min(file.name.count("/") for file in drives[key])
            name = "-".join(map(make_visible, PurePosixPath(key).parts[-max(depth, 1) :]))
        taken = {other.casefold() for other in names.values()}
        numbered = (f"{name}-{number}" for number in range(2, len(drives) + 2))
        names[key] = next(each for each in (name, *numbered) if each.casefold() not in taken)
    return names


def _name_folder(folder: PurePosixPath, files: Sequence[RawFile]) -> str:
    (first, *others) = files
    if first.is_source and first.member is None and not others:
        return make_visible(first.filename.partition(".")[0] or first.filename)
    name = folder.name.removesuffix(ARCHIVE_SUFFIX)
    return make_visible(name or "drive")
