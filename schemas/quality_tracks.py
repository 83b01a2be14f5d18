"""Parts of `quality.json` about subsets, findings, speeds and track starts; see `schemas.quality` for the document."""

from typing import Annotated, TypedDict

Dataset = Annotated[str, "ngsim or highd"]
Subset = Annotated[str, "one carriageway (arterials: one direction) of one recording"]
SubsetOrAll = Annotated[str | None, "one subset; null: the whole dataset"]
Recording = Annotated[str, "one continuous camera recording"]
Site = Annotated[str, "place of the recording"]
Direction = Annotated[str, "direction of travel"]


class Headline(TypedDict):
    """Figures of the whole lake."""

    datasets: Annotated[int, "datasets in the lake"]
    recordings: Annotated[int, "recordings in the lake"]
    subsets: Annotated[int, "subsets in the lake"]
    vehicles: Annotated[int, "tracks of all subsets"]
    entries: Annotated[int, "rows of `tracks`, all subsets"]
    recorded_s: Annotated[float, "length of all recordings; carriageways recorded at the same time count once"]
    driven_m: Annotated[float, "distance of all vehicles from first to last position"]
    least_flow_vphpl: Annotated[float | None, "least `flow_vphpl` of the subsets", "veh/h/lane"]
    greatest_flow_vphpl: Annotated[float | None, "greatest `flow_vphpl` of the subsets", "veh/h/lane"]
    excluded_subsets: Annotated[int | None, "subsets kept out of samples and splits; null before validation"]
    vehicles_with_errors: Annotated[int | None, "vehicles with a finding of severity error; null before validation"]
    late_starts: Annotated[int | None, "tracks that begin beyond the cut-off; null where none was judged"]
    eligible_starts: Annotated[int | None, "tracks whose start was judged"]
    samples: Annotated[int | None, "prediction origins of all protocols; null before the stage samples"]
    rows_read: Annotated[int | None, "data rows of all source files"]
    rows_dropped: Annotated[int | None, "data rows that were written to `rejects`"]


class StageProgress(TypedDict):
    """Progress of one stage, in subsets."""

    stage: Annotated[str, "validate, repair, samples or split"]
    possible: Annotated[int, "subsets that the stage can work on"]
    done: Annotated[int, "subsets that it has worked on"]


class LeftOut(TypedDict):
    """Subsets that later stages skip."""

    dataset: Dataset
    stages: Annotated[list[str], "stages that skip the subsets"]
    reason: Annotated[str, "why they skip them"]
    subsets: Annotated[list[str], "names of the subsets"]


class SubsetFacts(TypedDict):
    """A subset: its size, and whether it is excluded."""

    dataset: Dataset
    subset: Subset
    recording: Recording
    site: Site
    direction: Direction
    freeway: Annotated[bool, "false: an arterial street, without late starts, samples and splits"]
    frame_rate_hz: Annotated[float, "frame rate of the source"]
    lanes: Annotated[int | None, "main lanes"]
    seconds: Annotated[float, "length of the recording", "s"]
    vehicles: Annotated[int, "tracks"]
    entries: Annotated[int, "rows of `tracks`"]
    flow_vphpl: Annotated[
        float | None, "flow by Edie: distance driven on the main lanes / (length * lanes * seconds)", "veh/h/lane"
    ]
    vehicles_per_lane_s: Annotated[
        float | None, "vehicles / lanes / seconds, null where the lanes are unknown: no flow", "veh/lane/s"
    ]
    mean_speed_mps: Annotated[float | None, "recorded speed, mean over entries"]
    ids_split: Annotated[int, "source ids that stood for more than one vehicle"]
    backward_vehicles: Annotated[int | None, "vehicles with an entry of negative speed; null before validation"]
    excluded: Annotated[bool | None, "kept out of samples and splits; null before validation"]
    excluded_reason: Annotated[str | None, "null unless excluded"]
    columns_missing: Annotated[list[str], "columns of `tracks` that the source does not have"]


class RecordingFacts(TypedDict):
    """A recording: found in the lake, and announced."""

    dataset: Dataset
    recording: Recording
    site: Site
    subsets: Annotated[int, "subsets in the lake"]
    seconds: Annotated[float, "length of the recording", "s"]
    vehicles: Annotated[int, "tracks"]
    vehicles_announced: Annotated[int | None, "vehicles by the authority; null without one"]
    vehicles_announced_by: Annotated[str | None, "published, recordingMeta, tracksMeta or Total_Frames"]
    vehicles_found_share: Annotated[float | None, "source ids found / announced"]
    entries: Annotated[int, "rows of `tracks`"]
    entries_announced: Annotated[int | None, "entries by the authority; null without one"]
    entries_announced_by: Annotated[str | None, "published, recordingMeta, tracksMeta or Total_Frames"]
    entries_found_share: Annotated[float | None, "entries found / announced"]


class ThresholdValue(TypedDict):
    """Value of one threshold of a rule."""

    name: Annotated[str, "name of the setting"]
    value: Annotated[float, "value that validation used; see `provenance.thresholds_elsewhere`", "`unit`"]
    default: Annotated[float, "value unless set", "`unit`"]
    unit: Annotated[str, "unit of value and default"]


class Found(TypedDict):
    """Counts of a rule's findings; null where it was checked in no subset."""

    subsets_checked: Annotated[int, "subsets in which the rule was checked"]
    subsets_all: Annotated[int, "subsets in all"]
    runs: Annotated[int | None, "findings: runs of consecutive entries of one vehicle"]
    vehicles: Annotated[int | None, "vehicles with a finding"]
    vehicle_share: Annotated[float | None, "share of the vehicles"]
    entries: Annotated[int | None, "entries that break the rule"]
    entry_share: Annotated[float | None, "share of the entries"]
    worst: Annotated[float | None, "value of the worst entry; null where no entry breaks the rule", "`rules[].unit`"]


class FoundInDataset(Found):
    """Counts of a rule's findings in a dataset."""

    dataset: Dataset


class FoundInSubset(FoundInDataset):
    """Counts of a rule's findings in a subset."""

    subset: Subset


class RuleFindings(TypedDict):
    """Declaration of a rule and its findings."""

    name: Annotated[str, "name as in `findings.rule`; rules that no entry breaks are listed too"]
    severity: Annotated[str, "error, warning or info"]
    unit: Annotated[str, "unit of `worst`"]
    thresholds: list[ThresholdValue]
    meaning: Annotated[str, "when an entry breaks the rule"]
    source: Annotated[str, "origin of the rule or its threshold"]
    columns: Annotated[list[str], "columns that the rule reads"]
    total: Found
    datasets: list[FoundInDataset]
    subsets: list[FoundInSubset]


class SubsetScores(TypedDict):
    """Feasibility and consistency of a subset's tracks."""

    dataset: Dataset
    subset: Subset
    entries: Annotated[int, "rows of `tracks`"]
    share_without_error: Annotated[float, "entries that break no rule of severity error", "0 to 1"]
    share_without_warning: Annotated[float, "entries that break no rule of severity error or warning", "0 to 1"]
    vehicles_without_error: Annotated[float, "vehicles without an error in any entry", "0 to 1"]
    vehicles_without_warning: Annotated[float, "vehicles without an error or a warning in any entry", "0 to 1"]
    speed_rms_mps: Annotated[float | None, "root mean square of recorded - recomputed speed"]
    accel_rms_mps2: Annotated[float | None, "root mean square of recorded - recomputed acceleration"]
    high_jerk_share: Annotated[float | None, "entries that break high_jerk, among those with a jerk"]
    worst_jerk_mps3: Annotated[float | None, "greatest magnitude of the jerk"]
    jerk_flicker_share: Annotated[float | None, "entries that break jerk_flicker, among those with a jerk"]
    spacing_rms_m: Annotated[float | None, "root mean square of recorded headway - headway from positions"]
    spacings: Annotated[int, "entries behind spacing_rms_m"]
    rules_unchecked: Annotated[list[str], "rules that read a column which the source lacks"]


class SpeedQuantiles(TypedDict):
    """Distribution of recorded speeds."""

    dataset: Dataset
    subset: SubsetOrAll
    min_mps: Annotated[float, "least speed"]
    p2_5_mps: Annotated[float, "2.5 % quantile"]
    median_mps: Annotated[float, "50 % quantile"]
    p97_5_mps: Annotated[float, "97.5 % quantile"]
    max_mps: Annotated[float, "greatest speed"]
    mean_mps: Annotated[float, "mean speed"]
    std_mps: Annotated[float | None, "sample standard deviation; null of a single value"]


class SpeedsOfEntries(SpeedQuantiles):
    """Distribution of speeds over entries."""

    entries: Annotated[int, "entries in the distribution"]


class SpeedsPerSecond(SpeedQuantiles):
    """Distribution over means per vehicle and whole second."""

    seconds: Annotated[int, "means in the distribution", ""]


class SpeedBin(TypedDict):
    """Entries per bin of speed."""

    dataset: Dataset
    speed_mps: Annotated[int, "least speed of the bin [speed_mps, speed_mps + 1)"]
    entries: Annotated[int, "entries in the bin"]
    share: Annotated[float, "share of the dataset's entries"]


class Speeds(TypedDict):
    """Distributions of recorded speeds."""

    summary: list[SpeedsOfEntries]
    per_second: list[SpeedsPerSecond]
    histogram: list[SpeedBin]


class PublishedFigures(TypedDict):
    """Published figures of a recording or a dataset."""

    dataset: Dataset
    recording: Annotated[str | None, "recording; null: the whole dataset"]
    vehicles: Annotated[int | None, "tracks"]
    entries: Annotated[int | None, "rows"]
    p2_5_mps: Annotated[float, "2.5 % quantile of speeds averaged per vehicle and second"]
    median_mps: Annotated[float, "50 % quantile of these speeds"]
    p97_5_mps: Annotated[float, "97.5 % quantile of these speeds"]
    mean_mps: Annotated[float, "mean of these speeds"]
    std_mps: Annotated[float, "standard deviation of these speeds"]
    headway_vehicles: Annotated[int | None, "vehicles with a negative headway"]
    headway_entries: Annotated[int | None, "entries of negative headway"]
    acceleration_entries: Annotated[int | None, "entries of high acceleration"]
    slow_vehicles: Annotated[int | None, "vehicles at a low constant speed"]


class Published(TypedDict):
    """Published figures and their source."""

    source: Annotated[str, "source of the figures"]
    figures: list[PublishedFigures]


class SubsetStarts(TypedDict):
    """Track starts of one subset."""

    dataset: Dataset
    subset: Subset
    cutoff_m: Annotated[float | None, "a track that begins beyond this position starts late; null where unknown"]
    eligible: Annotated[int, "tracks whose start was judged"]
    late: Annotated[int, "late starts among them"]
    late_share: Annotated[float | None, "late / eligible"]
    fully_tracked: Annotated[int, "vehicles that late starts are compared with"]
    early: Annotated[int, "vehicles that begin while the road ahead is unrecorded"]
    windows: Annotated[int, "repair windows: late starts with an estimate"]
    by_regression: Annotated[int, "windows estimated by regression (the others by mean speed)"]
    median_estimated_s: Annotated[float | None, "estimated missing time, median of the windows"]
    max_estimated_s: Annotated[float | None, "longest estimated missing time"]
    window_s: Annotated[float | None, "length of all windows together"]
    median_start_speed_mps: Annotated[float | None, "first speed of the late starts, median"]
    furthest_start_m: Annotated[float | None, "greatest first position of the late starts"]
    median_r2: Annotated[float | None, "coefficient of determination of the regressions, median", "0 to 1"]
    road_seen_from_frame: Annotated[int | None, "first frame at which the whole road ahead is recorded"]


class StartPosition(TypedDict):
    """Tracks that begin within two metres."""

    dataset: Dataset
    subset: Subset
    start_x_m: Annotated[int, "least first position of the bin [start_x_m, start_x_m + 2)"]
    judged: Annotated[str, "on time, late or not judged"]
    vehicles: Annotated[int, "vehicles whose first position is in the bin"]


class Assessment(TypedDict):
    """Quality of repair windows, measured on tracks that were cut."""

    estimator: Annotated[str, "regression (used for the windows), mean_speed, no_margin or local_regression"]
    starts: Annotated[int, "fully tracked vehicles that were cut, all positions together"]
    starts_covered_share: Annotated[float, "starts whose window covers all that is missing"]
    missing_s: Annotated[float, "true missing time of all starts together"]
    coverage: Annotated[float | None, "missing time within the windows / missing time", "0 to 1"]
    excess: Annotated[float | None, "other time within the windows / missing time", "1"]
    mean_excess_s: Annotated[float, "other time within the windows, mean per start"]
    mean_error_s: Annotated[float, "estimate - truth without the margin, mean per start; positive is too long"]


class SubsetAssessment(Assessment):
    """Quality of repair windows in a subset."""

    dataset: Annotated[str | None, "ngsim or highd; null: the whole lake"]
    subset: Annotated[str | None, "one subset; null: the whole dataset or lake"]


class PositionAssessment(Assessment):
    """Quality of repair windows by the position of the cut."""

    dataset: Dataset
    beyond_m: Annotated[float, "position at which the cut tracks start, from the cut-off"]


class Assessed(TypedDict):
    """Quality of repair windows."""

    subsets: list[SubsetAssessment]
    positions: list[PositionAssessment]


class Starts(TypedDict):
    """Track starts and their assessment."""

    subsets: list[SubsetStarts]
    positions: list[StartPosition]
    assessed: Assessed
