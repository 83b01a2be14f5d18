"""Gain from smoothing: the same models with histories of recorded, filtered and reconstructed tracks.

A reconstructed position was smoothed with what follows it, so that a history of such positions knows a little of its
future. Here every model predicts the same samples from histories of all three kinds; the futures stay those of the
tensors. Predictions are compared on the carriageway, so that an error of the last position counts.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import polars as pl

from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.tables import format_number, print_table
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.planner import Planner
from tracklake.pipeline.stages.readers import LakeReader
from tracklake.pipeline.stages.stage import RECONSTRUCTION, StageError
from tracklake.pipeline.transforms.resample import join_key, put_on_clock
from tracklake.schemas.arrays import Floats, expand_ranges
from tracklake.schemas.protocols import FILTERED_TRACKS, RECONSTRUCTED_TRACKS, RECORDED, TracksFrom
from tracklake.training.data.gathers import locate_rows, read_samples, select_ego_truth
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.evaluation.scores import find_strata, measure_samples
from tracklake.training.models.prediction import Prediction
from tracklake.training.runs.forecasters import BATCH_SIZE, Forecaster

RESAMPLES = 400
"""Number of times that vehicles are drawn, with replacement, for an interval."""
INTERVAL = (2.5, 97.5)
"""Percentiles of the resampled differences between which an interval lies."""
Histories = Mapping[TracksFrom, TensorFolder]
"""Tensors with the positions of each kind of tracks."""
COLUMNS = {
    "model": pl.String,
    "histories": pl.String,
    "seconds": pl.Float64,
    "n": pl.Int64,
    "rmse_m": pl.Float64,
    "gain_m": pl.Float64,
    "gain_low_m": pl.Float64,
    "gain_high_m": pl.Float64,
}
"""Columns of scores: gain is the RMSE with filtered histories minus that with these, with its 95 % interval."""


@dataclass(frozen=True)
class GainInputs:
    """The samples of a part, with histories of every kind of tracks; `notes` tell what is lacking."""

    folder: TensorFolder
    histories: Histories
    part: str
    nearest: int
    notes: tuple[str, ...] = ()


def open_histories(settings: Settings, reader: LakeReader, folder: TensorFolder, part: str, nearest: int) -> GainInputs:
    """Open the tensors with positions of every kind of tracks that the lake has."""
    own = folder.protocol.tracks_from
    histories: dict[TracksFrom, TensorFolder] = {}
    notes = []
    for kind in (RECORDED, FILTERED_TRACKS, RECONSTRUCTED_TRACKS):
        try:
            if kind == RECONSTRUCTED_TRACKS:
                Planner(settings.lake, reader.manifest, settings).require(RECONSTRUCTION)
        except StageError as missing:
            notes.append(f"no reconstructed histories: {missing}")
            continue
        histories[kind], lacking = (folder, 0) if kind == own else replace_histories(reader, folder, kind, part)
        if lacking:
            notes.append(f"{lacking:,} rows have no {kind} position, and keep the {own} one")
    return GainInputs(folder, histories, part, nearest, tuple(notes))


def replace_histories(
    reader: LakeReader, folder: TensorFolder, kind: TracksFrom, part: str
) -> tuple[TensorFolder, int]:
    """Return tensors with other tracks' positions in a part's subsets, and the number of rows that those lack."""
    first, lengths = folder.run_first_row[:-1], np.diff(folder.run_first_row)
    rows = np.arange(len(folder.position_m))
    positions = locate_rows(folder, rows).copy()
    ticks = np.repeat(folder.run_first_tick - first, lengths) + rows
    keys = join_key(np.repeat(folder.run_vehicle_id, lengths), ticks)
    lacking, wanted = 0, folder.subsets_of(part)
    for number, named in enumerate(folder.index["subsets"]):
        if f"{named['dataset']}/{named['subset']}" not in wanted:
            continue
        run = np.flatnonzero(folder.run_subset == number)
        inside, _ = expand_ranges(first[run], lengths[run])
        subset = reader.open_subset(named["dataset"], named["subset"])
        tracks = subset.read_tracks_from(kind, "vehicle_id", "frame", "x_m", "y_m")
        clock = put_on_clock(tracks, rate_hz=folder.protocol.rate_hz, **subset.clock)
        known = join_key(clock["vehicle_id"].to_numpy(), clock["tick"].to_numpy())
        at = np.minimum(np.searchsorted(known, keys[inside]), max(len(known) - 1, 0))
        found = known[at] == keys[inside] if len(known) else np.zeros(len(at), dtype=np.bool_)
        positions[inside[found]] = clock.select("x_m", "y_m").to_numpy()[at[found]]
        lacking += int((~found).sum())
    index = folder.index | {"storage": "float32"}
    return replace(folder, index=index, arrays={**folder.arrays, "position_m": positions}), lacking


def measure_gain(models: Iterable[Forecaster], inputs: GainInputs) -> pl.DataFrame:
    """Score models with histories of every kind, by model, kind and seconds; COLUMNS."""
    return pl.concat([pl.DataFrame(schema=COLUMNS), *(_measure_model(model, inputs) for model in models)])


def _measure_model(model: Forecaster, inputs: GainInputs) -> pl.DataFrame:
    folder, samples = inputs.folder, inputs.folder.samples_of(inputs.part)
    strata = find_strata(folder, samples)
    vehicle = strata.vehicle[strata.of_sample]
    at = np.array(folder.protocol.scored_ticks) - 1
    shape = (int(vehicle.max(initial=-1)) + 1, len(at))
    squares = {kind: np.zeros(shape) for kind in inputs.histories}
    count = np.zeros(shape)
    for start in range(0, len(samples), BATCH_SIZE):
        chosen, own = samples[start : start + BATCH_SIZE], vehicle[start : start + BATCH_SIZE]
        row = folder.sample_row[chosen].astype(np.int64)
        truth = select_ego_truth(read_samples(folder, chosen, model.reads, nearest=inputs.nearest)[1])
        np.add.at(count, own, truth.future_mask[:, at])
        for kind, tensors in inputs.histories.items():
            observed, _ = read_samples(tensors, chosen, model.reads, nearest=inputs.nearest)
            apart = locate_rows(folder, row) - locate_rows(tensors, row)  # of the last positions
            place_m = model.predictor.predict(observed).position_m - apart[:, None]
            measured = measure_samples(Prediction(place_m), truth)
            np.add.at(squares[kind], own, (measured["squared_longitudinal_m2"] + measured["squared_lateral_m2"])[:, at])
    seconds = [tick / folder.protocol.rate_hz for tick in folder.protocol.scored_ticks]
    return _summarise(model.name, seconds, squares, count)


def _summarise(model: str, seconds: list[float], squares: Mapping[TracksFrom, Floats], count: Floats) -> pl.DataFrame:
    """Sum up squared errors (vehicles, horizons) of each kind; intervals are of vehicles that are drawn again."""
    vehicles = len(count)
    drawn = np.random.default_rng(0).multinomial(vehicles, np.full(vehicles, 1 / max(vehicles, 1)), RESAMPLES)
    with np.errstate(invalid="ignore"):  # a horizon that no sample reaches has no RMSE
        rmse_m = {kind: np.sqrt(own.sum(axis=0) / count.sum(axis=0)) for kind, own in squares.items()}
        again = {kind: np.sqrt((drawn @ own) / (drawn @ count)) for kind, own in squares.items()}
    n = count.sum(axis=0).astype(np.int64)
    frames = []
    for kind in squares:
        gain = np.full((3, len(seconds)), np.nan)
        if kind != FILTERED_TRACKS:
            gain[0] = rmse_m[FILTERED_TRACKS] - rmse_m[kind]
            gain[1:, n > 0] = np.nanpercentile((again[FILTERED_TRACKS] - again[kind])[:, n > 0], INTERVAL, axis=0)
        figures = dict(zip(("gain_m", "gain_low_m", "gain_high_m"), gain, strict=True))
        rows = {"model": model, "histories": kind, "seconds": seconds, "n": n, "rmse_m": rmse_m[kind], **figures}
        frames.append(pl.DataFrame(rows).select(pl.col(name).cast(dtype) for name, dtype in COLUMNS.items()))
    return pl.concat(frames).fill_nan(None)


def show_gain(terminal: Terminal, scores: pl.DataFrame, inputs: GainInputs) -> None:
    """Print the RMSE of every model with each kind of histories, and the gain of reconstructed over filtered ones."""
    seconds = scores["seconds"].unique().sort().to_list()
    lines: list[list[str]] = []
    for (model, kind), rows in scores.group_by("model", "histories", maintain_order=True):
        lines.append([f"{model}, {kind}", *(format_number(own, 3) for own in rows["rmse_m"])])
        if kind == RECONSTRUCTED_TRACKS:
            for name, column in GAIN_LINES.items():
                lines.append([f"  {name}", *(format_number(own, 3) for own in rows[column])])
    title = f"RMSE, m, by the tracks of the histories; futures: {inputs.folder.protocol.tracks_from} tracks"
    print_table(terminal, ["", *(f"{ahead:g} s" for ahead in seconds)], lines, title=title, fold=True)
    explained = (EXPLANATION,) if RECONSTRUCTED_TRACKS in inputs.histories else ()
    for note in (*explained, *inputs.notes):
        terminal.print_line(note, style="dim")


GAIN_LINES = {"gain from smoothing": "gain_m", "its lower bound": "gain_low_m", "its upper bound": "gain_high_m"}
"""Columns of COLUMNS that lines of the table show, by name of the line."""
EXPLANATION = (
    "gain from smoothing: RMSE with filtered histories, which know the past alone, minus RMSE with reconstructed ones, "
    "which were smoothed with what follows; bounds: 95 % interval over vehicles"
)


def describe_causality(tracks_from: TracksFrom) -> str:
    """Describe what the causality guard found, and whether the histories themselves are causal."""
    found = "causality guard: no prediction changes with what comes after its moment; histories are of"
    kinds: Mapping[TracksFrom, str] = {
        RECORDED: "recorded tracks, as the data set has them",
        FILTERED_TRACKS: "tracks that were filtered by past entries alone",
        RECONSTRUCTED_TRACKS: "reconstructed tracks, which are not causal: they were smoothed with what follows",
    }
    return f"{found} {kinds[tracks_from]}"
