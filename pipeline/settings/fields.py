"""Declared settings: names, types, bounds, defaults and descriptions, and what follows from them."""

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator

from tracklake.schemas.protocols import (
    CSP,
    DRIVE_PROTOCOLS,
    PROTOCOLS,
    RECONSTRUCTED_TRACKS,
    RECORDED,
    Protocol,
    TracksFrom,
)
from tracklake.schemas.split_recipes import SPLIT_NAMES, TIME_BLOCKS, SplitName, SplitRecipe
from tracklake.schemas.text import suggest_name
from tracklake.schemas.traffic import SAFETY_THRESHOLDS

PROTOCOL_SETTINGS = ("min_future_s", "drop_error_findings", "nearest", "grid_cell_m", "split", "tracks_from")
"""Names of the settings that replace a protocol's own values."""


class DeclaredSettings(BaseModel):
    """All settings of the pipeline; each is part of the fingerprints of the tables that it influences."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, validate_default=True)

    lake: Path = Field(Path("lake"), description="folder of the lake, or its address, such as s3://bucket/lake")
    cache: Path | None = Field(
        None, description="folder for the copies of lakes on object stores; none: in the user's folder of caches"
    )
    cache_gb: float = Field(
        50.0, ge=0, description="about as much of a lake on an object store is kept on this machine, in GB"
    )
    columns: Path | None = Field(None, description="mapping of the columns of raw files in a format of their own")
    recording: str | None = Field(
        None,
        pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$",
        description="name of the recording of a file without usable times; none: the file's name; I-24: makes one "
        "recording of all of it, instead of one for each 5 minutes",
    )
    workers: int = Field(min(os.cpu_count() or 1, 4), ge=1, description="recordings worked on at once")
    slice_entries: int = Field(
        2_000_000,
        ge=1,
        description="entries of a subset that a worker holds at once: longer ones are worked on in slices of time, "
        "where a stage can, with equal results",
    )
    runner: Literal["threads", "dask"] = Field(
        "threads", description="where recordings are worked on: threads of this process, or Dask workers"
    )
    kept_generations: int = Field(
        2, ge=1, description="earlier states of the lake that are kept for `tracklake sql --as-of`, with their files"
    )
    kept_hours: float = Field(
        0.0, ge=0, description="replaced files are kept for so many hours at least, however many runs follow"
    )
    refusals_fail: bool = Field(
        False, description="a Prefect run that refused files ends as Failed, not as CompletedWithRefusals"
    )
    pages_of: list[str] = Field(
        default_factory=list, description="subsets whose pages the report of more than 400 subsets draws"
    )
    dask_address: str | None = Field(None, description="address of a Dask scheduler; none: a cluster on this machine")
    thresholds: dict[str, float] = Field(
        default_factory=dict, description="thresholds of the rules by name, such as high_acceleration_mps2"
    )
    max_backward_share: float = Field(
        0.01, ge=0, le=1, description="a subset with a larger share of vehicles driving backwards is excluded"
    )
    car_following_min_s: float = Field(2.0, ge=0, description="car_following: shortest episode, s")
    lane_change_lateral_mps: float = Field(
        0.2, gt=0, description="lane_change_events: lateral speed at which the motion begins and ends, m/s"
    )
    safety_thresholds: dict[str, Annotated[float, Field(gt=0)]] = Field(
        default_factory=dict, description="safety: thresholds by measure, such as ttc_s"
    )
    detector_spacing_m: float = Field(100.0, ge=1, description="virtual_detectors: distance between detectors, m")
    detector_interval_s: float = Field(30.0, ge=1, description="virtual_detectors: length of an interval, s")
    edie_cell_m: float = Field(100.0, ge=1, description="edie: length of a cell along the road, m")
    edie_cell_s: float = Field(30.0, ge=1, description="edie: length of a cell in time, s")
    on_ramp_lanes: dict[str, list[Annotated[int, Field(ge=1)]]] = Field(
        default_factory=dict, description="lanes that are on-ramps by site, where the source does not state them"
    )
    reconstruct: bool = Field(True, description="`tracklake run` reconstructs tracks and checks them")
    reconstruct_noise_m: float | None = Field(
        None, gt=0, le=10, description="noise of recorded positions along the road, m; none: estimated"
    )
    reconstruct_lateral_noise_m: float | None = Field(
        None, gt=0, le=10, description="noise of recorded positions across the road, m; none: estimated"
    )
    reconstruct_max_gap_s: float = Field(
        2.0, ge=0, le=2, description="longest gap in a track that its reconstruction fills, s; 0: none is filled"
    )
    tracks_from: TracksFrom = Field(
        RECORDED,
        description="tracks that samples, tensors, exports and tables for traffic research are made of: as recorded, "
        "filtered by past entries alone, or reconstructed",
    )
    protocol: str = Field(CSP.name, description="name of the protocol")
    min_future_s: float | None = Field(
        None, gt=0, description="future track that a sample needs, s, up to the horizon; none: the protocol's"
    )
    drop_error_findings: bool | None = Field(
        None,
        description="no samples where the vehicle breaks a rule of severity error in the history or the horizon; none: "
        "the protocol's",
    )
    nearest: int | None = Field(
        None, ge=0, le=100, description="nearest vehicles listed with each sample, 0 = none; none: the protocol's"
    )
    grid_cell_m: float | None = Field(
        None,
        ge=1,
        le=100,
        description="cell of the 13 x 3 grid of neighbors, m, which reaches six cells ahead and behind; none: the "
        "protocol's",
    )
    validation_part: bool = Field(
        False,
        description="10 % of a split are a validation part, taken from the training part (70 / 10 / 20, not 80 / 20 %)",
    )
    split: SplitName | None = Field(None, description="split that tensors are made of; none: the protocol's")
    splits: list[SplitName] = Field(
        list(SPLIT_NAMES), description="splits that are made; tensors are made of one of them"
    )
    tensor_positions: Literal["float32", "int16-decimetres", "int16-centimetres"] = Field(
        "float32", description="how tensors store positions; int16 halves them and rounds along the road"
    )
    onboard_lidar: bool = Field(True, description="drives: LiDAR is used to track the vehicles around the ego")
    onboard_camera: bool = Field(True, description="drives: camera boxes are used to track the vehicles around the ego")
    split_seed: int = Field(0, ge=0, description="seed of the splits' searches and draws")
    split_block_s: float = Field(120.0, ge=10, description="time-blocks: length of a block, s")
    split_purge_s: float = Field(
        8.0, ge=0, description="time-blocks: time between two blocks, s; at least history and future"
    )
    split_eval_block: int | None = Field(
        None,
        ge=0,
        description="time-blocks: block of each recording that is eval, all others train (leave-one-block-"
        "out); none: allocated by flow",
    )
    drop_cut_samples: bool = Field(
        False, description="time-blocks: samples of val and eval with a neighbor that is cut off are left out"
    )

    @field_validator("*", mode="before")
    @classmethod
    def _refuse_booleans(cls, value: object, info: ValidationInfo) -> object:
        """Refuse true and false where a number is expected, for which pydantic takes 1 and 0."""
        is_switch = "bool" in str(cls.model_fields[str(info.field_name)].annotation)
        held = value.values() if isinstance(value, Mapping) else [value]
        if not is_switch and any(isinstance(each, bool) for each in held):
            raise ValueError("expected a number or a text, not true or false")
        return value

    @field_validator("protocol")
    @classmethod
    def _check_protocol(cls, name: str) -> str:
        if name in DRIVE_PROTOCOLS:
            drives = f"{name} is for drives, and `tracklake onboard` uses it by itself"
            raise ValueError(f"{drives}; expected one of {', '.join(PROTOCOLS)}")
        if name not in PROTOCOLS:
            raise ValueError(f"no protocol is called {name}; {suggest_name(name, PROTOCOLS)}")
        return name

    @field_validator("tracks_from")
    @classmethod
    def _check_tracks(cls, tracks_from: TracksFrom, others: ValidationInfo) -> TracksFrom:
        if tracks_from == RECONSTRUCTED_TRACKS and not others.data.get("reconstruct", True):
            raise ValueError("expected reconstruct = true with it")
        return tracks_from

    @field_validator("safety_thresholds")
    @classmethod
    def _check_measures(cls, thresholds: dict[str, float]) -> dict[str, float]:
        for name in thresholds:
            if name not in SAFETY_THRESHOLDS:
                raise ValueError(f"no measure is called {name}; {suggest_name(name, SAFETY_THRESHOLDS)}")
        return thresholds

    @field_validator("min_future_s")
    @classmethod
    def _check_min_future(cls, seconds: float | None, others: ValidationInfo) -> float | None:
        protocol = PROTOCOLS.get(others.data.get("protocol", ""))
        if seconds is not None and protocol is not None and seconds > protocol.horizon_s:
            raise ValueError(f"expected {protocol.horizon_s:g} or less, the horizon of the protocol {protocol.name}")
        return seconds

    @field_validator("splits")
    @classmethod
    def _check_splits(cls, names: list[SplitName], others: ValidationInfo) -> list[SplitName]:
        protocol = PROTOCOLS.get(others.data.get("protocol", ""))
        trains = others.data.get("split") or (protocol.split if protocol is not None else None)
        if trains not in (None, *names):
            raise ValueError(f"expected {trains!r} among them, the split that tensors are made of")
        return names

    @field_validator("split_purge_s")
    @classmethod
    def _check_purge(cls, purge_s: float, others: ValidationInfo) -> float:
        protocol = PROTOCOLS.get(others.data.get("protocol", ""))
        if protocol is not None and purge_s < protocol.history_s + protocol.horizon_s:
            raise ValueError(f"expected {protocol.history_s + protocol.horizon_s:g} or more, history and future")
        return purge_s

    @field_validator("split_eval_block")
    @classmethod
    def _check_eval_block(cls, block: int | None, others: ValidationInfo) -> int | None:
        if block is not None and others.data.get("split") != TIME_BLOCKS:
            raise ValueError(f'expected split = "{TIME_BLOCKS}" with it')
        return block

    def get_protocol(self) -> Protocol:
        """Return the protocol with the settings that change it."""
        changes: dict[str, Any] = {name: getattr(self, name) for name in PROTOCOL_SETTINGS}
        return replace(
            PROTOCOLS[self.protocol], **{name: value for name, value in changes.items() if value is not None}
        )

    def get_split_recipe(self, name: str | None = None) -> SplitRecipe:
        """Return the recipe of a split; None: of the protocol's."""
        trains = name or self.get_protocol().split
        return next(recipe for recipe in self.get_split_recipes() if recipe.name == trains)

    def get_split_recipes(self) -> list[SplitRecipe]:
        """Return the recipes of all splits to make, in the order of SPLIT_NAMES."""
        protocol = self.get_protocol()
        return [
            SplitRecipe(
                name=name,
                train_share=protocol.train_share,
                validation=self.validation_part,
                seed=self.split_seed,
                block_s=self.split_block_s,
                purge_s=self.split_purge_s,
                rate_hz=protocol.rate_hz,
                history_s=protocol.history_s,
                horizon_s=protocol.horizon_s,
                min_future_s=protocol.min_future_s,
                eval_block=self.split_eval_block,
            )
            for name in SPLIT_NAMES
            if name in self.splits
        ]
