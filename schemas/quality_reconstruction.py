"""Part of `quality.json` about reconstructed tracks; see `schemas.quality` for the document."""

from typing import Annotated

from typing_extensions import TypedDict

from tracklake.schemas.quality_tracks import Dataset, Subset, SubsetOrAll


class ReconstructedTracks(TypedDict):
    """Noise of a subset's or dataset's recorded tracks, how far they were moved, errors before and after."""

    dataset: Dataset
    subset: SubsetOrAll
    subsets: Annotated[int, "subsets with reconstructed tracks"]
    vehicles: Annotated[int, "their vehicles"]
    vehicles_reconstructed: Annotated[int, "vehicles whose track, or a part of it, was reconstructed"]
    entries: Annotated[int, "recorded entries that were reconstructed"]
    imputed_entries: Annotated[int, "entries that fill gaps"]
    imputed_share: Annotated[float, "share of the reconstructed tracks' entries that fill gaps"]
    constrained_share: Annotated[float, "share that the bounds moved"]
    noise_x_m: Annotated[float | None, "noise of recorded x_m, standard deviation; of a dataset the subsets' median"]
    noise_y_m: Annotated[float | None, "the same of y_m"]
    noise_is_set: Annotated[bool, "true: a setting states the noise, of a dataset that of any subset"]
    median_moved_m: Annotated[float | None, "median distance from the recorded position; of a dataset the median's"]
    moved_over_half_m_share: Annotated[float | None, "share of the recorded entries that moved more than 0.5 m"]
    moved_over_2_m_share: Annotated[float | None, "share of them that moved more than 2 m"]
    bounds_not_kept: Annotated[int, "runs of entries that break a bound all the same"]
    vehicles_with_errors_before: Annotated[
        int | None,
        "vehicles that break a rule of severity error as recorded, by rules checked on both; null: not checked",
    ]
    vehicles_with_errors_after: Annotated[int | None, "the same as reconstructed"]


class ReconstructedRule(TypedDict):
    """Vehicles and entries that break a rule, recorded and reconstructed, where it was checked on both."""

    rule: Annotated[str, "name of the rule"]
    dataset: Annotated[str | None, "ngsim, highd or custom; null: the whole lake"]
    subset: SubsetOrAll
    vehicles_before: Annotated[int, "vehicles that break it as recorded"]
    vehicles_after: Annotated[int, "vehicles that break it as reconstructed"]
    entries_before: Annotated[int, "entries that break it as recorded"]
    entries_after: Annotated[int, "entries that break it as reconstructed"]
    entry_share_before: Annotated[float, "share of the recorded entries"]
    entry_share_after: Annotated[float, "share of the entries of reconstructed tracks"]


class UnkeptBound(TypedDict):
    """Runs of entries of a subset that break a bound after reconstruction."""

    dataset: Dataset
    subset: Subset
    bound: Annotated[str, "name of the bound"]
    runs: Annotated[int, "runs of consecutive entries"]
    vehicles: Annotated[int, "vehicles with such a run"]
    entries: Annotated[int, "entries in these runs"]
    worst: Annotated[float, "most extreme value of either sign", "the bound's"]


class ReconstructionSkip(TypedDict):
    """Vehicles of a subset that were left out of the reconstruction for one reason."""

    dataset: Dataset
    subset: Subset
    reason: Annotated[str, "why; see `reconstruction_skips` in [tables.md](tables.md)"]
    vehicles: Annotated[int, "vehicles concerned"]
    entries: Annotated[int, "their entries"]
    left_out: Annotated[str, "what was not done"]


class ReconstructionFigures(TypedDict):
    """Reconstructed tracks beside the recorded ones."""

    datasets: list[ReconstructedTracks]
    subsets: list[ReconstructedTracks]
    rules: list[ReconstructedRule]
    unkept_bounds: list[UnkeptBound]
    skips: list[ReconstructionSkip]
