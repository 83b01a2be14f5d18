"""Parts of `quality.json` about drives of instrumented vehicles; see `schemas.quality` for the document."""

from typing import Annotated

from typing_extensions import TypedDict

Drive = Annotated[str, "name of the drive, its subset"]
FromM = Annotated[float, "least distance from the ego in the bin"]
UntilM = Annotated[float, "distance that the bin ends before"]


class DriveFacts(TypedDict):
    """A drive: what it holds, what happened to its messages, and how well the vehicles around it are known."""

    drive: Drive
    recording: Annotated[str, "folder or file that the drive was read from"]
    origin: Annotated[str, "recorded, or synthetic: derived by `tracklake instrument`"]
    start_utc: Annotated[str, "moment of its first record, ISO 8601, UTC"]
    seconds: Annotated[float, "from the first record to the last", "s"]
    mean_speed_mps: Annotated[float | None, "the ego's speed, mean over its states"]
    stations: Annotated[int, "other vehicles whose messages were kept"]
    messages: Annotated[int, "messages of other vehicles that were kept"]
    own_messages: Annotated[int, "messages of the ego"]
    lost: Annotated[int, "messages of other vehicles missing by their counters"]
    lost_share: Annotated[float | None, "lost / (lost + messages)"]
    duplicates: Annotated[int, "messages of other vehicles dropped: the same counter and moment as one kept"]
    invalid: Annotated[int, "messages of other vehicles dropped for an impossible position or time"]
    id_changes: Annotated[int, "times that other vehicles were given another temporary id"]
    clock_steps: Annotated[int, "times that the clock of another vehicle jumped by over 0.5 s"]
    latency_median_s: Annotated[float | None, "received - generated; null where either is unlogged"]
    latency_p95_s: Annotated[float | None, "the same, exceeded by 5 % of the messages"]
    scans: Annotated[int, "LiDAR scans"]
    images: Annotated[int, "camera images"]
    vehicles: Annotated[int, "vehicles around the ego, those that only LiDAR saw among them"]
    vehicle_ticks: Annotated[int, "rows of `surrounding`: one vehicle at one tick of 0.1 s"]
    v2v_share: Annotated[float | None, "of vehicle_ticks: a message arrived"]
    lidar_share: Annotated[float | None, "of vehicle_ticks: a LiDAR cluster was assigned"]
    camera_share: Annotated[float | None, "of vehicle_ticks: a camera box was assigned"]
    predicted_share: Annotated[float | None, "of vehicle_ticks: none of these, so that it is predicted only"]
    true_ticks: Annotated[int, "vehicle_ticks with a true position; 0 where the drive was recorded"]
    message_error_median_m: Annotated[float | None, "distance of the last message's position from the true one"]
    error_median_m: Annotated[float | None, "distance of the fused position, by records until then, from the true one"]
    error_p95_m: Annotated[float | None, "the same, exceeded at 5 % of the ticks"]
    smoothed_error_median_m: Annotated[float | None, "the same of positions smoothed by the whole drive"]
    findings: Annotated[int | None, "runs of messages or ticks that break a rule; null before they are checked"]
    errors: Annotated[int | None, "those of severity error"]


class DriveStation(TypedDict):
    """A vehicle whose messages a drive logged."""

    drive: Drive
    vehicle_id: Annotated[int, "id in the drive's tables"]
    own: Annotated[bool, "whether it is the ego"]
    temporary_ids: Annotated[list[str], "ids in its messages, the first used first"]
    first_s: Annotated[float, "its first message, since the drive's start"]
    last_s: Annotated[float, "its last message"]
    length_m: Annotated[float | None, "as sent; null where never"]
    messages: Annotated[int, "messages kept"]
    lost: Annotated[int, "messages missing by its counter"]
    lost_share: Annotated[float | None, "lost / (lost + messages)"]
    duplicates: Annotated[int, "messages dropped: the same counter and moment as one kept"]
    invalid: Annotated[int, "messages dropped for an impossible position or time"]
    id_changes: Annotated[int, "times it was given another temporary id"]
    clock_steps: Annotated[int, "times its clock jumped by over 0.5 s"]
    latency_median_s: Annotated[float | None, "received - generated; null where either is unlogged"]


class DriveRule(TypedDict):
    """Findings of a rule in a drive."""

    drive: Drive
    rule: Annotated[str, "name as in `drive_findings.rule`; rules that nothing breaks are listed too"]
    severity: Annotated[str, "error, warning or info"]
    unit: Annotated[str, "unit of `worst`"]
    checked: Annotated[int, "messages or ticks that the rule could be checked on; 0: the log lacks what it reads"]
    entries: Annotated[int, "messages or ticks that break it"]
    entry_share: Annotated[float | None, "entries / checked"]
    vehicles: Annotated[int, "vehicles with one"]
    runs: Annotated[int, "findings: runs of consecutive ones"]
    worst: Annotated[float | None, "most extreme value; null where nothing breaks the rule", "`drives.rules[].unit`"]


class DriveLoss(TypedDict):
    """Messages of other vehicles by the distance of the sender."""

    drive: Drive
    from_m: FromM
    until_m: UntilM
    messages: Annotated[int, "messages kept"]
    lost: Annotated[int, "messages missing before these"]
    lost_share: Annotated[float, "lost / (lost + messages)"]


class DriveErrors(TypedDict):
    """Errors of positions against the truth of a synthetic drive, by true distance."""

    drive: Drive
    from_m: FromM
    until_m: UntilM
    ticks: Annotated[int, "vehicles' ticks in the bin"]
    message_error_median_m: Annotated[float | None, "of the last message alone"]
    message_error_p95_m: Annotated[float | None, "the same, exceeded at 5 % of the ticks"]
    error_median_m: Annotated[float, "of the fused position, by records until then"]
    error_p95_m: Annotated[float, "the same, exceeded at 5 % of the ticks"]
    smoothed_error_median_m: Annotated[float, "of the position smoothed by the whole drive"]
    smoothed_error_p95_m: Annotated[float, "the same, exceeded at 5 % of the ticks"]


class DriveScore(TypedDict):
    """Errors of a model's predictions of the vehicles around the ego at one horizon, over all drives."""

    model: Annotated[str, "name of the run, or of the published model"]
    origin: Annotated[str, "measured here, or published: on the authors' own recordings"]
    seconds: Annotated[float, "horizon", "s"]
    n: Annotated[int, "predictions behind it; 0: published, not stated"]
    mae_m: Annotated[float | None, "mean distance of the predicted position from the true one"]
    mae_m_low: Annotated[float | None, "lower end of its 95 % interval, by drawing trajectories", "m"]
    mae_m_high: Annotated[float | None, "upper end of it", "m"]
    rmse_m: Annotated[float | None, "root mean square of that distance"]
    cell_share: Annotated[float | None, "share of the positions in the predicted one of nine cells"]
    cell_with_forest_share: Annotated[float | None, "the same where a forest gives the column of cells"]


class DriveWarnings(TypedDict):
    """Collision warnings of a model against the truth, over all drives."""

    model: Annotated[str, "name of the run"]
    n: Annotated[int, "predictions: one vehicle at one moment"]
    true: Annotated[int, "predictions whose cells overlap the ego's in truth"]
    hits: Annotated[int, "those that were warned of"]
    missed: Annotated[int, "those that were not"]
    false: Annotated[int, "warnings without an overlap in truth"]
    warnings_per_hour: Annotated[float | None, "runs of warnings, by the time that vehicles were near", "1/h"]
    median_time_s: Annotated[float | None, "predicted time to the overlap, median over warnings"]


class Drives(TypedDict):
    """Drives of instrumented vehicles."""

    drives: list[DriveFacts]
    stations: list[DriveStation]
    rules: list[DriveRule]
    losses: list[DriveLoss]
    errors: list[DriveErrors]
    scores: list[DriveScore]
    warnings: list[DriveWarnings]
