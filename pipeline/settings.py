"""Settings: `tracklake.toml`, then the environment (`TRACKLAKE_*`), then flags."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Literal

from pydantic import Field, ValidationInfo, field_validator
from pydantic_settings import BaseSettings, PydanticBaseSettingsSource, SettingsConfigDict, TomlConfigSettingsSource

from schemas.protocols import PROTOCOLS, Protocol
from schemas.split_recipes import SPLIT_NAMES, SplitName, SplitRecipe


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
    protocol: str = Field("csp", description="name of the protocol")
    min_future_s: float = Field(
        0.2, gt=0, le=5, description="track that a sample needs after it; 5 = full futures only"
    )
    drop_error_findings: bool = Field(
        False, description="no samples where the vehicle breaks a rule of severity error in the history or the horizon"
    )
    nearest: int = Field(10, ge=0, le=100, description="nearest vehicles listed with each sample; 0 = none")
    validation_part: bool = Field(False, description="70 / 10 / 20 % with a validation part instead of 80 / 20 %")
    split: SplitName = Field("flow-balanced", description="the split that tensors are made of")
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

    @field_validator("splits")
    @classmethod
    def _trains(cls, names: list[SplitName], others: ValidationInfo) -> list[SplitName]:
        if others.data.get("split") not in (None, *names):
            raise ValueError(f"expected {others.data['split']!r} among them, the split that tensors are made of")
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
        return replace(
            PROTOCOLS[self.protocol],
            min_future_s=self.min_future_s,
            drop_error_findings=self.drop_error_findings,
            nearest=self.nearest,
            split=self.split,
        )

    def get_split_recipe(self) -> SplitRecipe:
        """That of the split that tensors are made of."""
        return next(recipe for recipe in self.get_split_recipes() if recipe.name == self.split)

    def get_split_recipes(self) -> list[SplitRecipe]:
        """The splits to make, each with every parameter, in the order of SPLIT_NAMES."""
        protocol = self.get_protocol()
        return [
            SplitRecipe(
                name=name,
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
