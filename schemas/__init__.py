"""Declarations that all packages share: tables, files, protocols, errors; and helpers that need none of the packages.

Importing it imports nothing heavier than polars and pandera; `arrays` and `drawings` are imported where they are used.
"""

from tracklake.schemas.columns import StructureError as StructureError
from tracklake.schemas.columns import Table as Table
from tracklake.schemas.columns import column as column
from tracklake.schemas.completeness import COMPLETENESS as COMPLETENESS
from tracklake.schemas.drives import DRIVES as DRIVES
from tracklake.schemas.drives import STATIONS as STATIONS
from tracklake.schemas.findings import FINDINGS as FINDINGS
from tracklake.schemas.ingestion import INGEST_LOG as INGEST_LOG
from tracklake.schemas.ingestion import REJECTS as REJECTS
from tracklake.schemas.messages import BSM as BSM
from tracklake.schemas.messages import EGO_STATES as EGO_STATES
from tracklake.schemas.missing_starts import MISSING_STARTS as MISSING_STARTS
from tracklake.schemas.missing_starts import START_CUTOFFS as START_CUTOFFS
from tracklake.schemas.perception import ASSOCIATION as ASSOCIATION
from tracklake.schemas.perception import DETECTIONS as DETECTIONS
from tracklake.schemas.perception import DRIVE_CHECKS as DRIVE_CHECKS
from tracklake.schemas.perception import DRIVE_FINDINGS as DRIVE_FINDINGS
from tracklake.schemas.perception import LIDAR_CLUSTERS as LIDAR_CLUSTERS
from tracklake.schemas.perception import LIDAR_RETURNS as LIDAR_RETURNS
from tracklake.schemas.perception import SURROUNDING as SURROUNDING
from tracklake.schemas.perception import SURROUNDING_TRUTH as SURROUNDING_TRUTH
from tracklake.schemas.reconstruction import RECONSTRUCTED as RECONSTRUCTED
from tracklake.schemas.reconstruction import RECONSTRUCTED_FINDINGS as RECONSTRUCTED_FINDINGS
from tracklake.schemas.reconstruction import RECONSTRUCTED_SUBSET_SCORES as RECONSTRUCTED_SUBSET_SCORES
from tracklake.schemas.reconstruction import RECONSTRUCTION_QUALITY as RECONSTRUCTION_QUALITY
from tracklake.schemas.reconstruction import RECONSTRUCTION_SKIPS as RECONSTRUCTION_SKIPS
from tracklake.schemas.reconstruction import UNKEPT_BOUNDS as UNKEPT_BOUNDS
from tracklake.schemas.samples import NEIGHBORS as NEIGHBORS
from tracklake.schemas.samples import SAMPLE_COUNTS as SAMPLE_COUNTS
from tracklake.schemas.samples import SAMPLE_DROPS as SAMPLE_DROPS
from tracklake.schemas.samples import SAMPLES as SAMPLES
from tracklake.schemas.scores import SUBSET_SCORES as SUBSET_SCORES
from tracklake.schemas.scores import VEHICLE_SCORES as VEHICLE_SCORES
from tracklake.schemas.split_leakage import SPLIT_CONTEXT as SPLIT_CONTEXT
from tracklake.schemas.split_leakage import SPLIT_LEAKAGE as SPLIT_LEAKAGE
from tracklake.schemas.split_leakage import SPLIT_SHIFTS as SPLIT_SHIFTS
from tracklake.schemas.splits import SPLIT_BALANCE as SPLIT_BALANCE
from tracklake.schemas.splits import SPLIT_LEFT_OUT as SPLIT_LEFT_OUT
from tracklake.schemas.splits import SPLIT_RECIPES as SPLIT_RECIPES
from tracklake.schemas.splits import SPLITS as SPLITS
from tracklake.schemas.start_assessments import START_ASSESSMENTS as START_ASSESSMENTS
from tracklake.schemas.subsets import SUBSET_STATUS as SUBSET_STATUS
from tracklake.schemas.subsets import SUBSETS as SUBSETS
from tracklake.schemas.tracks import TRACKS as TRACKS
from tracklake.schemas.traffic import CAR_FOLLOWING as CAR_FOLLOWING
from tracklake.schemas.traffic import EDIE as EDIE
from tracklake.schemas.traffic import LANE_CHANGE_EVENTS as LANE_CHANGE_EVENTS
from tracklake.schemas.traffic import SAFETY as SAFETY
from tracklake.schemas.traffic import TRAFFIC_SKIPS as TRAFFIC_SKIPS
from tracklake.schemas.traffic import VIRTUAL_DETECTORS as VIRTUAL_DETECTORS
from tracklake.schemas.vehicles import VEHICLE_STARTS as VEHICLE_STARTS
from tracklake.schemas.vehicles import VEHICLES as VEHICLES

SCHEMA_VERSION = 3
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
    RECONSTRUCTED,
    RECONSTRUCTION_QUALITY,
    RECONSTRUCTION_SKIPS,
    UNKEPT_BOUNDS,
    RECONSTRUCTED_FINDINGS,
    RECONSTRUCTED_SUBSET_SCORES,
    CAR_FOLLOWING,
    LANE_CHANGE_EVENTS,
    SAFETY,
    VIRTUAL_DETECTORS,
    EDIE,
    TRAFFIC_SKIPS,
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
    DRIVES,
    STATIONS,
    BSM,
    EGO_STATES,
    DETECTIONS,
    LIDAR_RETURNS,
    LIDAR_CLUSTERS,
    ASSOCIATION,
    SURROUNDING,
    SURROUNDING_TRUTH,
    DRIVE_FINDINGS,
    DRIVE_CHECKS,
)
