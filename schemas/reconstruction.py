"""`reconstructed` and the tables about it: physically possible tracks, how far they moved, what could not be kept."""

import polars as pl

from tracklake.schemas.columns import PLACE, Table, column
from tracklake.schemas.findings import FINDINGS
from tracklake.schemas.scores import SUBSET_SCORES

BOUNDS_KEPT = ("backward", "acceleration", "deceleration", "jerk", "overlap", "lateral_acceleration")
"""Names of the bounds that a reconstructed track keeps."""
SKIP_REASONS = ("one_entry", "constant_gaps", "no_lanes", "no_length", "arterial", "too_few_entries", "out_of_range")
"""Why tracks, or parts of the work on them, are left out of the reconstruction."""

RECONSTRUCTED = Table(
    "reconstructed",
    "One row per entry of a reconstructed track, and per entry that fills a gap of at most 2 s: physically possible "
    "positions near the recorded ones. `tracks` stays as recorded; tracks that are skipped have no rows here.",
    key=("vehicle_id", "frame"),
    columns={
        **PLACE,
        "vehicle_id": column(pl.Int32, "unique within the subset", ge=0),
        "frame": column(pl.Int32, "the source's frame number, or that of an entry that fills a gap", ge=0),
        "time_s": column(pl.Float64, "since the recording's first frame", unit="s", ge=0),
        "x_m": column(pl.Float64, "front centre along the direction of travel", unit="m", ge=-2_000, le=20_000),
        "y_m": column(
            pl.Float64,
            "front centre from the carriageway's left edge, positive to the driver's right",
            unit="m",
            ge=-2_000,
            le=2_000,
        ),
        "speed_mps": column(pl.Float32, "rate of change of x_m", unit="m/s", ge=-40, le=100),
        "accel_mps2": column(pl.Float32, "rate of change of speed_mps", unit="m/s2", ge=-200, le=200),
        "lateral_speed_mps": column(pl.Float32, "rate of change of y_m, positive to the driver's right", unit="m/s"),
        "moved_m": column(
            pl.Float32, "distance from the recorded position; null where imputed", unit="m", nullable=True, ge=0
        ),
        "imputed": column(pl.Boolean, "the entry fills a gap: nothing was recorded"),
        "constrained": column(
            pl.Boolean, "the smoothed track broke a bound here and a quadratic program under the bounds replaced it"
        ),
    },
)

RECONSTRUCTION_QUALITY = Table(
    "reconstruction_quality",
    "One row per subset: noise of the recorded positions, and how far the reconstruction moved them.",
    key=("subset",),
    columns={
        **PLACE,
        "vehicles": column(pl.Int32, "vehicles of the subset", ge=0),
        "vehicles_reconstructed": column(pl.Int32, "of them, reconstructed", ge=0),
        "entries": column(pl.Int64, "recorded entries that were reconstructed", ge=0),
        "imputed_entries": column(pl.Int64, "entries that fill gaps", ge=0),
        "constrained_entries": column(pl.Int64, "entries that the bounds moved", ge=0),
        "noise_x_m": column(
            pl.Float64,
            "standard deviation of the recorded x_m's noise before, estimated or set; null where nothing was done",
            unit="m",
            nullable=True,
            ge=0,
        ),
        "noise_y_m": column(pl.Float64, "the same of y_m", unit="m", nullable=True, ge=0),
        "noise_is_set": column(pl.Boolean, "the noise is a setting's, not estimated"),
        "weight_x_s6": column(
            pl.Float64, "weight of the squared third derivative of x_m, used", unit="s6", nullable=True, ge=0
        ),
        "weight_y_s6": column(pl.Float64, "the same of y_m", unit="s6", nullable=True, ge=0),
        "median_moved_m": column(pl.Float64, "median of moved_m", unit="m", nullable=True, ge=0),
        "moved_over_half_m_share": column(
            pl.Float64, "share of entries that moved more than 0.5 m", nullable=True, ge=0, le=1
        ),
        "moved_over_2_m_share": column(
            pl.Float64, "share of entries that moved more than 2 m", nullable=True, ge=0, le=1
        ),
        "bounds_not_kept": column(pl.Int32, "rows of unkept_bounds", ge=0),
    },
)

UNKEPT_BOUNDS = Table(
    "unkept_bounds",
    "One row per run of consecutive entries of a reconstructed track that breaks a bound all the same.",
    key=("vehicle_id", "bound", "first_frame"),
    columns={
        **PLACE,
        "vehicle_id": column(pl.Int32, "whose entries they are", ge=0),
        "bound": column(pl.String, "the bound's name", isin=BOUNDS_KEPT),
        "first_frame": column(pl.Int32, "first entry of the run"),
        "last_frame": column(pl.Int32, "last entry of the run"),
        "entries": column(pl.Int32, "entries in the run", ge=1),
        "worst": column(pl.Float64, "the most extreme value in the run, in the bound's unit"),
    },
)

RECONSTRUCTION_SKIPS = Table(
    "reconstruction_skips",
    "One row per subset and reason: what was left out of the reconstruction.",
    key=("subset", "reason"),
    columns={
        **PLACE,
        "reason": column(pl.String, "why", isin=SKIP_REASONS),
        "vehicles": column(pl.Int32, "vehicles concerned", ge=1),
        "entries": column(pl.Int64, "their entries", ge=1),
        "left_out": column(pl.String, "what was not done: all of it, or the part that needs what is lacking"),
    },
)

RECONSTRUCTED_FINDINGS = Table(
    "reconstructed_findings",
    "The rules' findings on the reconstructed tracks; the columns are those of `findings`.",
    key=FINDINGS.key,
    columns=FINDINGS.columns,
)

RECONSTRUCTED_SUBSET_SCORES = Table(
    "reconstructed_subset_scores",
    "The scores of each subset's reconstructed tracks; the columns are those of `subset_scores`.",
    key=SUBSET_SCORES.key,
    columns=SUBSET_SCORES.columns,
    partition=SUBSET_SCORES.partition,
)
