"""Small lakes made in process, from raw text on, for what is exported from them."""

from pathlib import Path

from raw_texts import as_text, ngsim_row, read_highd, read_ngsim, write
from small_recordings import write_highd
from stage_runs import run_stage

from tracklake.pipeline.lake import Commit, open_for_writing, write_table
from tracklake.pipeline.settings import Settings
from tracklake.schemas import SUBSETS, TRACKS, VEHICLES

FINGERPRINT = "0" * 16
KEYS = {
    "us-101-0750": 1118846978900,
    "us-101-0805": 1118847842000,
    "us-101-0820": 1118848757000,
    "i-80-1600": 1113433134900,
    "i-80-1700": 1113436766900,
    "i-80-1715": 1113437564900,
}
"""Global_Time - 100 * Frame_ID of the six freeway recordings, in the script's order of data sets."""


def find_speeds(rows):
    """Speed in ft/s of each (vehicle, frame), by its way since the frame before."""
    along = {(v, f): float(y) for v, f, _, y, _ in rows}
    return {(v, f): 10 * abs(y - along.get((v, f - 1), y)) for (v, f), y in along.items()}


def write_ngsim(folder, recordings):
    """The original text: {recording: rows (Vehicle_ID, Frame_ID, Local_X, Local_Y, Lane_ID)}, numbers or text."""
    paths = []
    for recording, rows in recordings.items():
        speeds = find_speeds(rows)
        named = [
            ngsim_row(
                v, f, key=KEYS.get(recording, recording), Local_X=x, Local_Y=y, Lane_ID=lane, Total_Frames=99,
                v_Vel=f"{speeds[v, f]:.2f}",
            )
            for v, f, x, y, lane in rows
        ]  # fmt: skip
        paths.append(write(Path(folder) / f"{recording}.txt", as_text(named)))
    return paths


def ingest(root, folder, recordings, highd=()):
    """A lake of NGSIM texts and of highD recordings (of `small_recordings`) by number."""
    canonical = {}
    if recordings:
        found, _ = read_ngsim(folder, *write_ngsim(folder, recordings))
        canonical |= {("ngsim", name): value for name, value in found.items()}
    for number in highd:
        canonical["highd", number] = read_highd(write_highd(Path(folder) / "highd", number), number)
    return commit_recordings(root, canonical)


def commit_recordings(root, canonical):
    """A lake of recordings as sources return them: {(dataset, recording): Canonical}."""
    with open_for_writing(root) as writer:
        for (dataset, recording), made in canonical.items():
            files = {}
            for subset in made.subsets:
                values = {"dataset": dataset, "subset": subset.name}
                for table, frame in ((TRACKS, subset.tracks), (VEHICLES, subset.vehicles), (SUBSETS, subset.facts)):
                    written = write_table(root, table, frame, values, FINGERPRINT, where=recording)
                    files.setdefault(table.name, []).extend(written)
            subsets = [{"subset": s.name, "freeway": s.facts["freeway"][0]} for s in made.subsets]
            info = {"dataset": dataset, "recording": recording, "subsets": subsets, "row_order": made.row_order}
            writer.commit(Commit(f"ingest/{dataset}/{recording}", FINGERPRINT, files, {"sources": []}, info))
    return root


def run_stages(settings: Settings, *names):
    """Stages after ingestion, without Prefect."""
    for name in names:
        run_stage(settings.lake, name, settings)
