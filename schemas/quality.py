"""The document `quality.json`: every key with its type, its meaning and its unit, declared once.

A key is `Annotated[type, meaning]`, or `Annotated[type, meaning, unit]` where the name does not end in its unit (see
`UNITS`). docs/quality_json.md is derived from these classes.
"""

from typing import Annotated, Final, NotRequired

from typing_extensions import TypedDict

from tracklake.schemas.quality_drives import Drives
from tracklake.schemas.quality_reconstruction import ReconstructionFigures
from tracklake.schemas.quality_tracks import (
    Dataset,
    Direction,
    Headline,
    LeftOut,
    Published,
    Recording,
    RecordingFacts,
    RuleFindings,
    Site,
    Speeds,
    StageProgress,
    Starts,
    Subset,
    SubsetFacts,
    SubsetGroup,
    SubsetScores,
    SubsetTraffic,
    Verdict,
)

QUALITY_SCHEMA: Final = "tracklake/quality/1"
"""Version of the document; its number grows when a key changes its meaning or is removed."""

UNITS = {
    "_veh_per_lane_s": "veh/lane/s",
    "_mps3": "m/s³",
    "_mps2": "m/s²",
    "_mps": "m/s",
    "_hz": "Hz",
    "_m": "m",
    "_s": "s",
    "share": "0 to 1",
}
"""Units by the end of a key's name; the first that fits holds."""

File = Annotated[str, "path as given to ingestion"]
ProtocolName = Annotated[str, "protocol of the samples"]
SplitName = Annotated[str, "name of the split"]
Part = Annotated[str, "train, val or eval"]
FirstPart = Annotated[str, "first of two compared parts, in the order train, val, eval"]
OtherPart = Annotated[str, "second of the two compared parts"]


class SubsetSamples(TypedDict):
    """Samples of a subset by a protocol."""

    protocol: ProtocolName
    dataset: Dataset
    subset: Subset
    samples: Annotated[int, "prediction origins"]
    vehicles: Annotated[int, "vehicles with samples"]
    dropped: Annotated[int, "entries on the protocol's clock that are no samples"]
    kept_share: Annotated[float | None, "samples / (samples + dropped)"]
    lane_change_left: Annotated[int, "samples that change lanes to the left"]
    lane_change_right: Annotated[int, "samples that change lanes to the right"]
    brake: Annotated[int, "samples that brake"]
    mean_neighbors: Annotated[float | None, "neighbors per sample"]
    collisions: Annotated[int | None, "neighbors moved to the nearest free cell, theirs being taken by a nearer one"]
    all_collisions: Annotated[int | None, "the same in the grids of all entries at 10 Hz, as published counts are"]
    crowded_out: Annotated[int | None, "neighbors dropped because no cell was free"]


class SampleDrops(TypedDict):
    """Entries that are no samples, by reason."""

    protocol: ProtocolName
    dataset: Dataset
    reason: Annotated[str, "why an entry is no sample; the first reason that holds"]
    entries: Annotated[int, "entries dropped for the reason"]
    subsets: Annotated[int, "subsets in which the reason holds"]
    share: Annotated[float, "share of the entries on the protocol's clock"]


class Samples(TypedDict):
    """Samples and entries that are none."""

    subsets: list[SubsetSamples]
    drops: list[SampleDrops]


class SplitRecipe(TypedDict):
    """Recipe that divides the subsets."""

    split: SplitName
    meaning: Annotated[str, "how the split divides"]
    claims_no_leakage: Annotated[bool, "true: the run fails where its parts share anything"]
    trains: Annotated[bool, "true: tensors are made of this split"]
    window_s: Annotated[float, "history and future of a sample together"]
    digest: Annotated[str, "hash of every parameter"]
    parameters: Annotated[str, "every parameter, as JSON"]


class SplitBalance(TypedDict):
    """Size and flow of one part of a split."""

    split: SplitName
    dataset: Dataset
    part: Part
    subsets: Annotated[int, "subsets in the part"]
    vehicles: Annotated[int, "vehicles in the part"]
    vehicle_share: Annotated[float | None, "share of the dataset's vehicles that are in the split"]
    samples: Annotated[int, "samples in the part"]
    sample_share: Annotated[float | None, "share of the split's samples of the dataset"]
    vehicles_per_lane_s_mean: Annotated[
        float | None, "`vehicles_per_lane_s` of the part's subsets, mean weighted by samples", "veh/lane/s"
    ]
    vehicles_per_lane_s_std: Annotated[float | None, "the same, standard deviation", "veh/lane/s"]
    relaxed: Annotated[bool, "true: a constraint of the split could not be met"]
    relaxed_reason: Annotated[str | None, "constraint that could not be met"]


class SplitMember(TypedDict):
    """Blocks of a subset in one part."""

    split: SplitName
    dataset: Dataset
    subset: Subset
    site: Site
    direction: Direction
    part: Part
    blocks: Annotated[int, "blocks of the subset in the part"]
    block_s: Annotated[float, "length of these blocks together"]
    first_vehicle_id: Annotated[int | None, "least id of the vehicles in the part; null: all vehicles"]
    last_vehicle_id: Annotated[int | None, "greatest id of the vehicles in the part; null: all vehicles"]
    subset_vehicles: Annotated[int, "vehicles of the whole subset"]
    vehicles_per_lane_s: Annotated[float | None, "that of the whole subset", "veh/lane/s"]


class SplitLeakage(TypedDict):
    """Vehicles, frames, scenes and context that two parts share."""

    split: SplitName
    dataset: Dataset
    part: FirstPart
    other_part: OtherPart
    vehicles_shared: Annotated[int, "vehicles in both parts"]
    vehicles: Annotated[int, "vehicles in the other part"]
    vehicles_share: Annotated[float | None, "vehicles_shared / vehicles"]
    frames_shared: Annotated[int, "frames of a subset with entries in both parts"]
    frames: Annotated[int, "frames with entries in the other part"]
    frames_share: Annotated[float | None, "frames_shared / frames"]
    scenes_shared: Annotated[int, "moments of a subset with samples in both parts"]
    scenes: Annotated[int, "moments with samples in the other part"]
    scenes_share: Annotated[float | None, "scenes_shared / scenes"]
    context_shared: Annotated[int, "neighbors of samples of one part that are in the other one"]
    context: Annotated[int, "all neighbors of samples of both parts"]
    context_share: Annotated[float | None, "context_shared / context"]
    nearest_s: Annotated[float | None, "least time between entries of the parts in a subset; null: no common subset"]


class SplitContext(TypedDict):
    """Neighbors that a split cuts off."""

    split: SplitName
    dataset: Dataset
    part: Part
    samples: Annotated[int, "usable samples of the part"]
    neighbors: Annotated[int, "neighbors of these samples"]
    neighbors_elsewhere: Annotated[int, "neighbors cut off because they are in another part or block"]
    neighbors_left_out: Annotated[int, "neighbors cut off because they are in no part"]
    cut_share: Annotated[float | None, "neighbors cut off / neighbors"]


class SplitShift(TypedDict):
    """Difference of a quantity between two parts."""

    split: SplitName
    dataset: Dataset
    part: FirstPart
    other_part: OtherPart
    quantity: Annotated[str, "vehicles_per_lane_s (veh/lane/s), speed (m/s), left, right or brake (shares of samples)"]
    mean: Annotated[float, "mean in the first part", "of `quantity`"]
    other_mean: Annotated[float, "mean in the other part", "of `quantity`"]
    std: Annotated[float, "standard deviation in the first part", "of `quantity`"]
    other_std: Annotated[float, "standard deviation in the other part", "of `quantity`"]
    shift: Annotated[float, "greatest difference of the two cumulative distributions", "0 to 1"]


class SplitLeftOut(TypedDict):
    """Vehicles with entries in two parts."""

    split: SplitName
    dataset: Dataset
    vehicles: Annotated[int, "vehicles with entries in two parts"]
    entries: Annotated[int, "their entries, which val and eval do not use"]


class Splits(TypedDict):
    """Recipes, balance and leakage of the splits."""

    recipes: list[SplitRecipe]
    balance: list[SplitBalance]
    members: list[SplitMember]
    leakage: list[SplitLeakage]
    context: list[SplitContext]
    shifts: list[SplitShift]
    left_out: list[SplitLeftOut]


class Completeness(TypedDict):
    """A figure that was announced beside the one that was found."""

    dataset: Dataset
    recording: Recording
    authority: Annotated[str, "source of the announcement: recordingMeta, tracksMeta, Total_Frames or published"]
    measure: Annotated[str, "what is counted; see `completeness` in [tables.md](tables.md)"]
    expected: Annotated[int | None, "announced figure"]
    found: Annotated[int | None, "figure of the lake"]
    difference: Annotated[int | None, "found - expected"]
    found_share: Annotated[float | None, "found / expected"]
    agrees: Annotated[bool | None, "found = expected"]
    rows_dropped: Annotated[int | None, "rows in `rejects` that could be some of the missing ones"]


class DroppedRows(TypedDict):
    """Number of rows dropped for one reason."""

    reason: Annotated[str, "why rows were dropped"]
    rows: Annotated[int, "rows dropped for it"]


class IngestedFile(TypedDict):
    """Account of the rows of a source file."""

    dataset: Dataset
    file: File
    recording: Annotated[str | None, "recording of the rows; null: unknown"]
    dialect: Annotated[str, "how the file was read"]
    rows_read: Annotated[int, "rows_kept + rows_dropped"]
    rows_kept: Annotated[int, "rows that became entries or metadata"]
    rows_dropped: Annotated[int, "rows written to `rejects`"]
    dropped_share: Annotated[float | None, "rows_dropped / rows_read"]
    dropped_by_reason: list[DroppedRows]


class RejectedRow(TypedDict):
    """A rejected line; the first ten of each file are listed."""

    dataset: Dataset
    file: File
    recording: Annotated[str | None, "recording of the line; null: unknown"]
    line: Annotated[int, "line number in the file, from 1"]
    reason: Annotated[str, "why the line was rejected"]
    text: Annotated[str, "first 300 characters of the line"]
    cut: Annotated[bool, "true: the line is longer"]
    rejects_in_file: Annotated[int, "rejected lines of the file"]


class Ingestion(TypedDict):
    """Source files and rejected lines."""

    files: list[IngestedFile]
    rejects: list[RejectedRow]


class HorizonScore(TypedDict):
    """Errors of a model at one horizon."""

    seconds: Annotated[float, "horizon", "s"]
    rmse_m: Annotated[
        float | None, "root mean square error of the predicted position; null where lateral positions are lane centres"
    ]
    rmse_longitudinal_m: Annotated[float | None, "the same along the road alone"]
    n: Annotated[int, "predictions behind it"]


class ModelScores(TypedDict):
    """Errors of a model at all horizons."""

    model: Annotated[str, "name of the run"]
    part: Annotated[str, "part of the split that the model was evaluated on"]
    rows: list[HorizonScore]


class ShownSettings(TypedDict, total=False):
    """Settings that the report shows."""

    max_backward_share: Annotated[float, "a subset with a larger share of vehicles driving backwards is excluded"]
    on_ramp_lanes: Annotated[dict[str, list[int]], "lanes that are on-ramps, by site"]
    car_following_min_s: Annotated[float, "car_following: shortest episode"]
    lane_change_lateral_mps: Annotated[float, "lane_change_events: lateral speed at which the motion begins and ends"]
    safety_thresholds: Annotated[dict[str, float], "safety: thresholds by measure that are no defaults"]
    detector_spacing_m: Annotated[float, "virtual_detectors: distance between detectors"]
    detector_interval_s: Annotated[float, "virtual_detectors: length of an interval"]
    edie_cell_m: Annotated[float, "edie: length of a cell along the road"]
    edie_cell_s: Annotated[float, "edie: length of a cell in time"]
    reconstruct: Annotated[bool, "true: `tracklake run` reconstructs tracks"]
    reconstruct_noise_m: Annotated[float | None, "noise of recorded positions along the road; null: estimated"]
    reconstruct_lateral_noise_m: Annotated[float | None, "the same across the road"]
    reconstruct_max_gap_s: Annotated[float, "longest gap in a track that is filled"]
    tracks_from: Annotated[str, "tracks that samples are made of: recorded, filtered or reconstructed"]
    protocol: Annotated[str, "name of the protocol"]
    min_future_s: Annotated[float, "track that a sample needs after it"]
    drop_error_findings: Annotated[
        bool, "true: entries of vehicles that break an error rule around them are no samples"
    ]
    nearest: Annotated[int, "nearest vehicles listed with each sample; 0 = none"]
    grid_cell_m: Annotated[float, "length of a cell of the grid of neighbors"]
    validation_part: Annotated[bool, "true: the split has a validation part"]
    split: Annotated[str, "split that tensors are made of"]
    splits: Annotated[list[str], "splits that are made"]
    tensor_positions: Annotated[str, "storage of positions in tensors: float32, or whole decimetres or centimetres"]
    onboard_lidar: Annotated[bool, "true: LiDAR is used to track the vehicles around an ego"]
    onboard_camera: Annotated[bool, "true: camera boxes are used to track the vehicles around an ego"]
    split_seed: Annotated[int, "seed of the splits' searches and draws"]
    split_block_s: Annotated[float, "time-blocks: length of a block"]
    split_purge_s: Annotated[float, "time-blocks: time between two blocks"]
    split_eval_block: Annotated[int | None, "time-blocks: number of the block that is eval; null: allocated by flow"]
    drop_cut_samples: Annotated[bool, "true: val and eval of time-blocks leave out samples with a neighbor cut off"]


class Source(TypedDict):
    """Title, licence and citation of a dataset."""

    title: Annotated[str, "title of the dataset"]
    licence: Annotated[str, "licence of the dataset"]
    citation: Annotated[str, "citation of the dataset"]


class ProtocolDigest(TypedDict):
    """Name and digest of the run's protocol."""

    name: Annotated[str, "name of the protocol"]
    digest: Annotated[str, "hash of all its parameters"]


class SourceFile(TypedDict):
    """Digest of one source file."""

    dataset: Dataset
    file: File
    sha256: Annotated[str, "sha256 of the file's bytes"]


class Provenance(TypedDict, total=False):
    """Facts that make the report reproducible."""

    lake: Annotated[str, "name of the lake's folder"]
    lake_id: Annotated[str, "id given to the lake when it was made"]
    created: Annotated[str, "when the report was written, ISO 8601, UTC"]
    tracklake: Annotated[str, "version of tracklake"]
    python: Annotated[str, "version of Python"]
    versions: Annotated[dict[str, str], "version of the library of that name"]
    thresholds: Annotated[dict[str, float], "thresholds, by name, that most recordings used and that are no defaults"]
    thresholds_elsewhere: Annotated[
        dict[str, dict[str, float]], "by `dataset/recording` and name, thresholds of other recordings that differ"
    ]
    settings: ShownSettings
    data: dict[str, Source]
    protocol: ProtocolDigest
    source_files: list[SourceFile]


class Quality(TypedDict):
    """Everything that quality.json holds."""

    schema: Annotated[str, "version of this document"]
    headline: Headline
    verdicts: list[Verdict]
    stages: list[StageProgress]
    left_out: list[LeftOut]
    groups: NotRequired[list[SubsetGroup]]
    subsets: list[SubsetFacts]
    rules: list[RuleFindings]
    speeds: Speeds
    recordings: list[RecordingFacts]
    subset_scores: list[SubsetScores]
    published: Published
    traffic: NotRequired[list[SubsetTraffic]]
    starts: Starts
    samples: Samples
    splits: Splits
    completeness: list[Completeness]
    ingestion: Ingestion
    model_scores: list[ModelScores]
    reconstruction: NotRequired[ReconstructionFigures]
    drives: NotRequired[Drives]
    provenance: Provenance
