"""NGSIM's dialects as data: the fields of a file, their names, and the names of recordings."""

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from zoneinfo import ZoneInfo

from tracklake.pipeline.sources.csv import BOM, LINE, NULL_WORDS, UNNAMED, Layout
from tracklake.pipeline.sources.source import SourceError
from tracklake.schemas.columns import Origin
from tracklake.schemas.raw_ngsim import RAW_NGSIM

TEXT_FIELDS = (
    *("Vehicle_ID", "Frame_ID", "Total_Frames", "Global_Time", "Local_X", "Local_Y", "Global_X", "Global_Y"),
    *("v_length", "v_Width", "v_Class", "v_Vel", "v_Acc", "Lane_ID"),
    *("Preceding", "Following", "Space_Headway", "Time_Headway"),
)
"""Fields of the original text files, in order."""

EXPORT_FIELDS = (
    *TEXT_FIELDS[:14],
    *("O_Zone", "D_Zone", "Int_ID", "Section_ID", "Direction", "Movement"),
    *TEXT_FIELDS[14:],
    "Location",
)
"""Columns of the portal's export, in order."""

ALIASES = {
    "tot_frames": "Total_Frames",
    "epoch_ms": "Global_Time",
    "veh_len": "v_length",
    "veh_wid": "v_Width",
    "veh_class": "v_Class",
    "veh_velocity": "v_Vel",
    "vehicle_acc": "v_Acc",
    "org_zone": "O_Zone",
    "dest_zone": "D_Zone",
    "intersection": "Int_ID",
    "section": "Section_ID",
    "preceding_veh": "Preceding",
    "following_veh": "Following",
    "spacing": "Space_Headway",
    "headway": "Time_Headway",
    **{name.lower(): name for name in EXPORT_FIELDS},
}
"""Names that headers use, in lower case, and the raw schema's name of each."""

LOCATIONS = ("us-101", "i-80", "lankershim", "peachtree")
ESSENTIAL = ("Vehicle_ID", "Frame_ID", "Global_Time", "Local_X", "Local_Y", "v_Vel")
TEXT, CSV = "ngsim-text", "ngsim-csv"


@dataclass(frozen=True)
class Site:
    """A recording site of NGSIM.

    Args:
        name: value of Location.
        freeway: whether it is a freeway; else an arterial with several directions.
        direction: direction of travel on a freeway.
        lanes: number of main lanes of a freeway.
        on_ramp_lanes: lanes that are on-ramps.
        day: local date of the recordings.
    """

    name: str
    freeway: bool
    direction: str | None
    lanes: int | None
    on_ramp_lanes: tuple[int, ...]
    day: str


SITES = {
    site.name: site
    for site in (
        Site("us-101", True, "south", 5, (7,), "2005-06-15"),
        Site("i-80", True, "north", 6, (7,), "2005-04-13"),
        Site("lankershim", False, None, None, (), "2005-06-16"),
        Site("peachtree", False, None, None, (), "2006-11-08"),
    )
}

RECORDINGS = {
    1113433134900: "i-80-1600",
    1113436766900: "i-80-1700",
    1113437564900: "i-80-1715",
    1118846978900: "us-101-0750",
    1118847842000: "us-101-0805",
    1118848757000: "us-101-0820",
    1118936699900: "lankershim-0845",
    1163018600: "peachtree-1245",
    1163030300: "peachtree-1600",
}
"""Published recordings by Global_Time - 100 * Frame_ID, named by site and scheduled local start time.

Peachtree's clock counts seconds since 1970 (shifted by a time zone) but advances by 100 a frame: its keys are 11,700
apart, the 3 h 15 min between its two periods.
"""

SYNTHETIC_MS = 42
"""Milliseconds past a tenth of a second at which all times of generated files lie; recorded ones lie on the tenth."""

DAY_MS = 86_400_000
UNKNOWN = "unknown"
_LOCAL = ZoneInfo("America/Los_Angeles")


@cache
def name_recording(key: int, location: str | None) -> str:
    """Name the recording of a Global_Time - 100 * Frame_ID; the name begins with the site's.

    A key that is not published is a recording of its own, named by site, local date and local time of frame 1. If the
    file has no site, it is the one recorded on that day, else `unknown`.
    """
    if key in RECORDINGS:
        return RECORDINGS[key]
    start_ms = key + 100 - (SYNTHETIC_MS if _is_synthetic(key) else 0)
    try:
        start = datetime.fromtimestamp(start_ms / 1000, tz=UTC).astimezone(_LOCAL)
    except (OverflowError, ValueError, OSError):
        return f"{location or UNKNOWN}-{key}"
    by_day = {site.day: site.name for site in SITES.values()}
    site = location or by_day.get(f"{start:%Y-%m-%d}", UNKNOWN)
    rest = f"-{start_ms % 1000:03d}" if start_ms % 1000 else ""
    again = "-again" if start.fold else ""  # the hour repeated at the end of summer time
    return f"{site}-{start:%Y%m%d-%H%M%S}{rest}{again}"


def find_origin(keys: Iterable[int]) -> Origin:
    """Tell by a recording's values of Global_Time - 100 * Frame_ID whether it was generated."""
    return "synthetic" if any(map(_is_synthetic, keys)) else "recorded"


def _is_synthetic(key: int) -> bool:
    """Tell whether a time has the generator's milliseconds and day, which is that of US-101's recordings."""
    return key % 100 == SYNTHETIC_MS and any(
        name.startswith("us-101") and abs(key - known) < DAY_MS for known, name in RECORDINGS.items()
    )


def find_site(recording: str) -> str:
    """Find the site that a recording's name begins with."""
    return next((site for site in SITES if recording.startswith(f"{site}-")), UNKNOWN)


def detect(head: bytes, _name: str) -> str | None:
    """Recognise an NGSIM trajectory file by its first lines.

    A header that names the essential columns, or a line of 18 numbers: separated by commas, or by blanks.
    """
    lines = head.removeprefix(BOM).decode("utf-8", errors="replace").splitlines()[:25]
    if not lines:
        return None
    header = _canonical_names(lines[0])
    if set(ESSENTIAL) <= set(header):
        return CSV
    if any(_are_numbers(line.split(",")) for line in lines):
        return f"{CSV}-no-header"
    return TEXT if any(_are_numbers(line.split()) for line in lines) else None


def build_layout(head: bytes, dialect: str, *, where: str) -> Layout:
    """Build the layout of a file of a dialect from its first bytes; `where` names the file in the message.

    Raises:
        SourceError: two columns have one meaning.
    """
    if dialect == CSV:
        line = head.removeprefix(BOM).split(b"\n", 1)[0].decode("utf-8", errors="replace")
        names = _make_unique(_canonical_names(line), where)
    else:
        names = TEXT_FIELDS
    wanted = [name for name in RAW_NGSIM.columns if name in names and name != LINE]
    return Layout(
        names=names,
        dtypes={name: RAW_NGSIM.dtypes[name] for name in wanted},
        required=RAW_NGSIM.required & set(wanted),
        # The portal's export has them in five columns; other columns may have them too.
        thousands=frozenset(name for name in wanted if dialect == CSV and RAW_NGSIM.dtypes[name].is_numeric()),
        bounds={name: limits for name, limits in RAW_NGSIM.bounds.items() if name in wanted},
        choices={"Location": LOCATIONS} if "Location" in names else {},
        header_lines=1 if dialect == CSV else 0,
        blanks=dialect == TEXT,
    )


def _canonical_names(line: str) -> list[str]:
    names = [field.strip().strip('"') for field in line.rstrip("\r\n").split(",")]
    return [ALIASES.get(name.lower(), name) for name in names]


def _make_unique(names: list[str], where: str) -> tuple[str, ...]:
    """Make names unique: unknown fields are numbered if their name is missing, repeated or reserved."""
    taken = {LINE, ""}
    unique = []
    for number, name in enumerate(names, start=1):
        if name in taken and name in RAW_NGSIM.columns and name != LINE:
            raise SourceError(
                f"{where}, line 1: two columns stand for {name}. Expected one; remove or rename the other."
            )
        unique.append(f"{name}{UNNAMED}{number}" if name in taken else name)
        taken.add(name)
    return tuple(unique)


def _are_numbers(fields: list[str]) -> bool:
    """Whether a line's fields are the 18 numbers of a file without header; a few may be missing."""
    if len(fields) != len(TEXT_FIELDS):
        return False
    try:
        numbers = [float(field) for field in fields if field.strip().lower() not in ("", *NULL_WORDS)]
    except ValueError:
        return False
    return len(numbers) >= len(RAW_NGSIM.required)
