"""Settings: `tracklake.toml`, then the environment (`TRACKLAKE_*`), then flags."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationInfo, field_validator
from pydantic_settings import BaseSettings, PydanticBaseSettingsSource, SettingsConfigDict, TomlConfigSettingsSource

from tracklake.schemas.protocols import CSP, PROTOCOLS, Protocol
from tracklake.schemas.split_recipes import SPLIT_NAMES, SplitName, SplitRecipe

PROTOCOL_SETTINGS = ("min_future_s", "drop_error_findings", "nearest", "split")
"""Settings that take the place of a protocol's own values."""


class Settings(BaseSettings):
    """What a user may set; every value is part of the fingerprint of what it influences."""

    model_config = SettingsConfigDict(
        env_prefix="TRACKLAKE_", env_nested_delimiter="__", toml_file="tracklake.toml", extra="forbid", frozen=True
    )

    lake: Path = Field(Path("lake"), description="folder of the lake")
    workers: int = Field(min(os.cpu_count() or 1, 4), ge=1, description="recordings worked on at once")
    runner: Literal["threads", "dask"] = Field(
        "threads", description="where recordings are worked on: threads of this process, or Dask workers"
    )
    dask_address: str | None = Field(None, description="of a Dask scheduler; none: a cluster on this machine")
    thresholds: dict[str, float] = Field(
        default_factory=dict, description="of rules, by threshold name, such as high_acceleration_mps2"
    )
    max_backward_share: float = Field(
        0.01, ge=0, le=1, description="a subset with a larger share of vehicles driving backwards is excluded"
    )
    on_ramp_lanes: dict[str, list[int]] = Field(
        default_factory=dict, description="by site: lanes that are on-ramps, where the source does not know"
    )
    protocol: str = Field(CSP.name, description="name of the protocol")
    min_future_s: float | None = Field(
        None, gt=0, description="track that a sample needs after it, up to the horizon; none: the protocol's"
    )
    drop_error_findings: bool | None = Field(
        None,
        description="no samples where the vehicle breaks a rule of severity error in the history or the horizon; none: "
        "the protocol's",
    )
    nearest: int | None = Field(
        None, ge=0, le=100, description="nearest vehicles listed with each sample, 0 = none; none: the protocol's"
    )
    validation_part: bool = Field(
        False,
        description="10 % of a split are a validation part, taken from what trains (70 / 10 / 20 instead of 80 / 20 %)",
    )
    split: SplitName | None = Field(None, description="the split that tensors are made of; none: the protocol's")
    splits: list[SplitName] = Field(
        list(SPLIT_NAMES), description="the splits that are made; those that are not trained on stand beside it"
    )
    tensor_positions: Literal["float32", "int16-decimetres", "int16-centimetres"] = Field(
        "float32", description="how tensors store positions; int16 halves them and rounds along the road"
    )
    split_seed: int = Field(0, ge=0, description="seed of the splits' searches and draws")
    split_block_s: float = Field(120.0, ge=10, description="time-blocks: length of a block, s")
    split_purge_s: float = Field(
        8.0, ge=0, description="time-blocks: time between two blocks, s; at least history and future"
    )

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Flags win over the environment, the environment over the file."""
        del dotenv_settings, file_secret_settings
        return init_settings, env_settings, TomlConfigSettingsSource(settings_cls)

    @field_validator("protocol")
    @classmethod
    def _is_known(cls, name: str) -> str:
        if name not in PROTOCOLS:
            raise ValueError(f"expected one of {', '.join(PROTOCOLS)}")
        return name

    @field_validator("min_future_s")
    @classmethod
    def _ends(cls, seconds: float | None, others: ValidationInfo) -> float | None:
        protocol = PROTOCOLS.get(others.data.get("protocol", ""))
        if seconds is not None and protocol is not None and seconds > protocol.horizon_s:
            raise ValueError(f"expected {protocol.horizon_s:g} or less, the horizon of the protocol {protocol.name}")
        return seconds

    @field_validator("splits")
    @classmethod
    def _trains(cls, names: list[SplitName], others: ValidationInfo) -> list[SplitName]:
        protocol = PROTOCOLS.get(others.data.get("protocol", ""))
        trains = others.data.get("split") or (protocol.split if protocol is not None else None)
        if trains not in (None, *names):
            raise ValueError(f"expected {trains!r} among them, the split that tensors are made of")
        return names

    @field_validator("split_purge_s")
    @classmethod
    def _lasts(cls, purge_s: float, others: ValidationInfo) -> float:
        protocol = PROTOCOLS.get(others.data.get("protocol", ""))
        if protocol is not None and purge_s < protocol.history_s + protocol.horizon_s:
            raise ValueError(f"expected {protocol.history_s + protocol.horizon_s:g} or more, history and future")
        return purge_s

    def get_protocol(self) -> Protocol:
        """The protocol with the settings that change it."""
        changes: dict[str, Any] = {name: getattr(self, name) for name in PROTOCOL_SETTINGS}
        return replace(
            PROTOCOLS[self.protocol], **{name: value for name, value in changes.items() if value is not None}
        )

    def get_split_recipe(self) -> SplitRecipe:
        """That of the split that tensors are made of."""
        trains = self.get_protocol().split
        return next(recipe for recipe in self.get_split_recipes() if recipe.name == trains)

    def get_split_recipes(self) -> list[SplitRecipe]:
        """The splits to make, each with every parameter, in the order of SPLIT_NAMES."""
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
            )
            for name in SPLIT_NAMES
            if name in self.splits
        ]
