"""NGSIM's dialects as data: the fields of a file, their names, and the names of recordings."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from zoneinfo import ZoneInfo

from tracklake.pipeline.sources.source import RawFile
from tracklake.schemas.columns import Origin

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

_ALSO = {
    "Vehicle_ID": ("vehicleidentificationnumber", "vehicleidentification", "vehid"),
    "Frame_ID": ("frameidentificationnumber", "frameidentification", "framenumber"),
    "Total_Frames": ("totframes", "totalframe"),
    "Global_Time": ("epochms", "globaltimeepochtime"),
    "v_length": ("vehlen", "vlen", "vehiclelength"),
    "v_Width": ("vehwid", "vwid", "vehiclewidth"),
    "v_Class": ("vehclass", "vehicleclass"),
    "v_Vel": ("vehvelocity", "vehiclevelocity", "vvelocity", "vehiclespeed", "localvelocity"),
    "v_Acc": ("vehicleacc", "vehicleacceleration", "vacceleration", "localaccel"),
    "Lane_ID": ("laneidentification", "lanenumber"),
    "O_Zone": ("orgzone",),
    "D_Zone": ("destzone",),
    "Int_ID": ("intersection",),
    "Section_ID": ("section",),
    "Preceding": ("precedingveh", "precedingvehicle", "precedingvehicleid", "preceeding"),
    "Following": ("followingveh", "followingvehicle", "followingvehicleid"),
    "Space_Headway": ("spacing", "spacehdwy"),
    "Time_Headway": ("headway", "timehdwy"),
}
ALIASES = {
    **{name.lower().replace("_", ""): name for name in EXPORT_FIELDS},
    **{alias: name for name, aliases in _ALSO.items() for alias in aliases},
}
"""Names that headers use, in lower case without blanks and underscores, and the raw schema's name of each."""

_OFTEN = {
    "Vehicle_ID": ("id", "vehicle", "veh", "carid", "trackid", "agentid", "objectid"),
    "Frame_ID": ("frame", "frameno", "timestep", "step"),
    "Global_Time": ("time", "t", "timestamp", "epoch"),
    "Local_X": ("lateral", "lat", "laterallocation", "ylocal"),
    "Local_Y": ("longitudinal", "along", "position", "long"),
    "v_length": ("length", "len"),
    "v_Width": ("width",),
    "v_Class": ("class", "type", "vehicletype"),
    "v_Vel": ("v", "vel", "velocity", "speed"),
    "v_Acc": ("a", "acc", "accel", "acceleration"),
    "Lane_ID": ("lane",),
    "Preceding": ("leader", "leaderid", "precedingid", "lead"),
    "Following": ("follower", "followerid", "followingid"),
}
GUESSES = {alias: name for name, aliases in _OFTEN.items() for alias in aliases}
"""Likely meanings of names that are not NGSIM's, for the mapping that a refusal suggests."""
LOCATIONS = ("us-101", "i-80", "lankershim", "peachtree")


@dataclass(frozen=True)
class Site:
    """A recording site of NGSIM, with the local date of its recordings; an arterial has several directions."""

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


def name_file(file: RawFile, site: str | None = None) -> str:
    """Name the recording of a file that is one: as the user says, else after the file; the site comes first."""
    name = file.recording
    if not name:
        stem = re.sub(r"(\.(csv|tsv|txt|dat|gz|parquet|feather|arrow|mat))+$", "", file.filename.lower())
        name = re.sub(r"[^a-z0-9]+", "-", stem).strip("-") or UNKNOWN
    return name if site is None or name.startswith(site) else f"{site}-{name}"
