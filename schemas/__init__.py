"""Declarations of every table of the lake and of quality.json; nothing heavier than polars and pandera is imported."""

from tracklake.schemas.columns import StructureError, Table, column
from tracklake.schemas.completeness import COMPLETENESS
from tracklake.schemas.findings import FINDINGS
from tracklake.schemas.ingestion import INGEST_LOG, REJECTS
from tracklake.schemas.missing_starts import MISSING_STARTS, START_CUTOFFS
from tracklake.schemas.samples import NEIGHBORS, SAMPLE_COUNTS, SAMPLE_DROPS, SAMPLES
from tracklake.schemas.scores import SUBSET_SCORES, VEHICLE_SCORES
from tracklake.schemas.split_leakage import SPLIT_CONTEXT, SPLIT_LEAKAGE, SPLIT_SHIFTS
from tracklake.schemas.splits import SPLIT_BALANCE, SPLIT_LEFT_OUT, SPLIT_RECIPES, SPLITS
from tracklake.schemas.start_assessments import START_ASSESSMENTS
from tracklake.schemas.subsets import SUBSET_STATUS, SUBSETS
from tracklake.schemas.tracks import TRACKS
from tracklake.schemas.vehicles import VEHICLE_STARTS, VEHICLES

SCHEMA_VERSION = 2
"""Version of the tables below; it grows when an older lake can no longer be read."""

TABLES: tuple[Table, ...] = (
    TRACKS,
    VEHICLES,
    VEHICLE_STARTS,
    SUBSETS,
    SUBSET_STATUS,
    COMPLETENESS,
    INGEST_LOG,
    REJECTS,
    FINDINGS,
    VEHICLE_SCORES,
    SUBSET_SCORES,
    START_CUTOFFS,
    MISSING_STARTS,
    START_ASSESSMENTS,
    SAMPLES,
    SAMPLE_DROPS,
    SAMPLE_COUNTS,
    NEIGHBORS,
    SPLITS,
    SPLIT_LEFT_OUT,
    SPLIT_RECIPES,
    SPLIT_BALANCE,
    SPLIT_LEAKAGE,
    SPLIT_CONTEXT,
    SPLIT_SHIFTS,
)

__all__ = [
    "COMPLETENESS",
    "FINDINGS",
    "INGEST_LOG",
    "MISSING_STARTS",
    "NEIGHBORS",
    "REJECTS",
    "SAMPLES",
    "SAMPLE_COUNTS",
    "SAMPLE_DROPS",
    "SCHEMA_VERSION",
    "SPLITS",
    "SPLIT_BALANCE",
    "SPLIT_CONTEXT",
    "SPLIT_LEAKAGE",
    "SPLIT_LEFT_OUT",
    "SPLIT_RECIPES",
    "SPLIT_SHIFTS",
    "START_ASSESSMENTS",
    "START_CUTOFFS",
    "SUBSETS",
    "SUBSET_SCORES",
    "SUBSET_STATUS",
    "TABLES",
    "TRACKS",
    "VEHICLES",
    "VEHICLE_SCORES",
    "VEHICLE_STARTS",
    "StructureError",
    "Table",
    "column",
]
