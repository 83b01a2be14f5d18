"""The truth about a sample: the written files are read back and their contents counted.

This module and `expected_findings` loop over entries in Python on purpose: they share no code with the pipeline, its
sources or its rules, so that equal counts prove something.
"""

import csv
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import polars as pl

from tracklake.pipeline.synthetic.expected_findings import count_rules
from tracklake.pipeline.synthetic.scenery import Entry, Surface

TRUTH_SCHEMA = {
    "kind": pl.String(),
    "dataset": pl.String(),
    "recording": pl.String(),
    "subset": pl.String(),
    "file": pl.String(),
    "line": pl.Int64(),
    "vehicle_id": pl.Int64(),
    "name": pl.String(),
    "first_frame": pl.Int64(),
    "last_frame": pl.Int64(),
    "entries": pl.Int64(),
    "vehicles": pl.Int64(),
    "value": pl.Float64(),
}
"""kind = `defect`: an injected defect (`name`), on a vehicle's entries or a file's line.
`first_frame`: a vehicle's TRUE first and last frame and number of frames in the window, before any defect; value is
its true x_m at the first, from the window's entrance along the direction of travel (noise apart).
`lane_change`: a lane change (`name`: left, right) of varied traffic, and its true first and last frame, which may lie
outside the recording; value is its duration in s. `dose`: entries and vehicles of a subset that have the defect
(`name`) of a sample with a dose; value is the share of its vehicles. `rule`: entries and vehicles of a subset that
break a rule (`name`), as counted from the files; value is the number of runs of consecutive frames. `rows`: lines of a
file that are `read` (the header apart), `kept`, `malformed`, `duplicate`. `drive`: a file of the drive in folder
`recording`, of vehicle `vehicle_id` in `subset`, which takes value seconds. Null where a column does not apply."""

METRES_PER_FOOT = 0.3048
NGSIM_CLASSES = {1: "motorcycle", 2: "car", 3: "truck"}


@dataclass
class FileCount:
    """Lines of one file."""

    file: str
    dataset: str
    recording: str | None
    read: int = 0
    kept: int = 0
    malformed: int = 0
    duplicate: int = 0


@dataclass
class Found:
    """The contents read back: entries by subset and (vehicle, frame), and counts of lines.

    `hindmost` are positions by highD's recording, in m to the left in the image, from which x_m of the upper
    carriageway counts.
    """

    entries: dict[tuple[str, str, str], dict[tuple[int, int], Entry]] = field(default_factory=dict)
    surfaces: dict[str, Surface] = field(default_factory=dict)
    files: list[FileCount] = field(default_factory=list)
    hindmost: dict[str, float] = field(default_factory=dict)


def _split_row(line: str, separator: str | None, fields: int) -> list[str] | None:
    """Split a line into fields; None if it is no row of that many fields."""
    if "\0" in line or not line.strip():
        return None
    if separator is not None and line.count('"') % 2:
        return None
    parts: list[str] = line.split() if separator is None else next(csv.reader([line]))
    return parts if len(parts) == fields else None


def _number(text: str) -> float:
    value = float(text.replace(",", ""))
    if not math.isfinite(value):
        raise ValueError(text)
    return value


def _lines(path: Path) -> list[str]:
    text = path.read_bytes().decode("utf-8-sig")
    lines = text.split("\n")
    if lines[-1] == "":
        lines.pop()
    return [line.removesuffix("\r") for line in lines]


def _read_meta(
    folder: Path, recording: str, found: Found
) -> tuple[dict[int, int], dict[int, str], dict[int, tuple[float, float]], list[str]]:
    """Read directions, kinds and sizes of a recording's vehicles, and the recording's own facts; count the lines."""
    for suffix, fields in (("recordingMeta", 15), ("tracksMeta", 16)):
        name = f"{recording}_{suffix}.csv"
        count = FileCount(name, "highd", recording)
        for line in _lines(folder / name)[1:]:
            count.read += 1
            if _split_row(line, ",", fields) is None:
                count.malformed += 1
            else:
                count.kept += 1
        found.files.append(count)
    direction, kinds, sizes = {}, {}, {}
    for line in _lines(folder / f"{recording}_tracksMeta.csv")[1:]:
        meta = line.split(",")
        direction[int(meta[0])] = int(meta[7])
        kinds[int(meta[0])] = meta[6].lower()
        sizes[int(meta[0])] = float(meta[1]), float(meta[2])
    return direction, kinds, sizes, _lines(folder / f"{recording}_recordingMeta.csv")[1].split(",")


def read_highd(folder: Path, recording: str, found: Found) -> None:
    """Read the three files of a recording back."""
    direction, kinds, sizes, facts = _read_meta(folder, recording, found)
    upper, lower = ([float(y) for y in field.split(";")] for field in facts[13:15])
    markings = {"upper": [upper[-1] - y for y in reversed(upper)], "lower": [y - lower[0] for y in lower]}
    for side, places in markings.items():
        found.surfaces[f"{recording}-{side}"] = Surface(
            float(facts[1]),
            tuple(places),
            headway_stands_in=False,
            has_headings=True,
            lanes=len(places) - 1,
            ramps=(),
            first_frame=1,
        )
    path = folder / f"{recording}_tracks.csv"
    count = FileCount(path.name, "highd", recording)
    rows = {(int(row[1]), int(row[0])): row for row in _read_rows(_lines(path)[1:], ",", 25, range(25), count)}
    found.files.append(count)
    headings = find_headings(
        {key: (numbers[6], numbers[7]) for key, numbers in rows.items()}, direction, float(facts[1])
    )
    fronts = {}
    for key, numbers in rows.items():
        middle = numbers[2] + numbers[4] / 2
        fronts[key] = (-middle if direction[key[0]] == 1 else middle) + numbers[4] / 2 * math.cos(headings[key])
    hindmost = min((front for (vehicle, _), front in fronts.items() if direction[vehicle] == 1), default=0.0)
    found.hindmost[recording] = hindmost
    for (vehicle, frame), numbers in rows.items():
        left = direction[vehicle] == 1
        along = -1 if left else 1
        middle, lanes, lane = numbers[3] + numbers[5] / 2, len(upper) - 1, int(numbers[24])
        heading, half = headings[vehicle, frame], numbers[4] / 2
        entry = Entry(
            front=round(fronts[vehicle, frame] - (hindmost if left else 0), 3),
            length=sizes[vehicle][0],
            speed=along * numbers[6],
            accel=along * numbers[8],
            leader=int(numbers[16]),
            headway=numbers[12],
            y=round((upper[-1] - middle if left else middle - lower[0]) + half * math.sin(heading), 3),
            width=sizes[vehicle][1],
            lane=lanes + 2 - lane if left else lane - lanes - 2,
            kind=kinds[vehicle],
            heading=round(heading, 4),
            lateral=along * numbers[7],
            box=(numbers[4], numbers[5]),
        )
        subset = f"{recording}-{'upper' if left else 'lower'}"
        found.entries.setdefault(("highd", recording, subset), {})[vehicle, frame] = entry


def _read_rows(
    lines: Iterable[str], separator: str | None, fields: int, wanted: Iterable[int], count: FileCount
) -> Iterator[list[float]]:
    """Yield the wanted numbers of each line, without malformed and repeated ones; counts the lines."""
    seen = set()
    wanted = tuple(wanted)
    for line in lines:
        count.read += 1
        parts = _split_row(line, separator, fields)
        try:
            numbers = [_number(parts[place]) for place in wanted] if parts else None
        except ValueError:
            numbers = None
        if numbers is None:
            count.malformed += 1
        elif line in seen:
            count.duplicate += 1
        else:
            seen.add(line)
            count.kept += 1
            yield numbers


def find_headings(
    velocities: dict[tuple[int, int], tuple[float, float]], direction: dict[int, int], rate_hz: float
) -> dict[tuple[int, int], float]:
    """Find where vehicles point, rad to the right of the road, by their velocities, one entry after the other."""
    headings: dict[tuple[int, int], float] = {}
    last: dict[int, float] = {}
    for vehicle, frame in sorted(velocities):
        near = [velocities[vehicle, frame]]
        for step in (-1, 1):
            away = 1
            while away / rate_hz <= 0.1 and (vehicle, frame + step * away) in velocities:
                near.append(velocities[vehicle, frame + step * away])
                away += 1
        sign = -1 if direction[vehicle] == 1 else 1
        ahead, aside = (sign * sum(velocity[axis] for velocity in near) / len(near) for axis in (0, 1))
        if ahead > 0 and math.hypot(ahead, aside) >= 2:
            last[vehicle] = math.atan2(aside, ahead)
        headings[vehicle, frame] = last.get(vehicle, 0.0)
    return headings


def read_ngsim(path: Path, recordings: dict[int, str], found: Found) -> None:
    """Read an NGSIM file back; `recordings` are names by Global_Time - 100 * Frame_ID."""
    lines = _lines(path)
    header = lines[0].startswith("Vehicle_ID")
    fields = lines[0].count(",") + 1 if header else 18
    # Behind the lane, the 25-column export has six more columns before Preceding.
    behind = 14 + (6 if fields == 25 else 0)
    count = FileCount(path.name, "ngsim", next(iter(recordings.values())) if len(recordings) == 1 else None)
    wanted = (*range(14), *range(behind, behind + 4))
    for numbers in _read_rows(lines[1:] if header else lines, "," if header else None, fields, wanted, count):
        recording = recordings[int(numbers[3]) - 100 * int(numbers[1])]
        found.entries.setdefault(("ngsim", recording, recording), {})[int(numbers[0]), int(numbers[1])] = Entry(
            front=numbers[5] * METRES_PER_FOOT,
            length=numbers[8] * METRES_PER_FOOT,
            speed=numbers[11] * METRES_PER_FOOT,
            accel=numbers[12] * METRES_PER_FOOT,
            leader=int(numbers[14]),
            headway=numbers[16] * METRES_PER_FOOT,
            y=numbers[4] * METRES_PER_FOOT,
            width=numbers[9] * METRES_PER_FOOT,
            lane=int(numbers[13]),
            kind=NGSIM_CLASSES[int(numbers[10])],
        )
    found.files.append(count)


def list_counts(found: Found) -> list[dict[str, object]]:
    """List the `rule` and `rows` rows of the truth table."""
    rows: list[dict[str, object]] = []
    for (dataset, recording, subset), entries in sorted(found.entries.items()):
        for rule, (hits, vehicles, runs) in count_rules(entries, found.surfaces.get(subset, Surface())).items():
            rows.append(
                {
                    "kind": "rule", "dataset": dataset, "recording": recording, "subset": subset, "name": rule,
                    "entries": hits, "vehicles": vehicles, "value": float(runs),
                }
            )  # fmt: skip
    rows.extend(
        {
            "kind": "rows", "dataset": count.dataset, "recording": count.recording, "file": count.file,
            "name": name, "entries": getattr(count, name),
        }
        for count in found.files
        for name in ("read", "kept", "malformed", "duplicate")
    )  # fmt: skip
    return rows


def build_truth(rows: Iterable[dict[str, object]]) -> pl.DataFrame:
    """Put rows, of which any column may be missing, into TRUTH_SCHEMA."""
    return pl.DataFrame([{name: row.get(name) for name in TRUTH_SCHEMA} for row in rows], schema=TRUTH_SCHEMA)
