"""Settings: `tracklake.toml`, then the environment (`TRACKLAKE_*`), then flags."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Literal

from pydantic import Field, field_validator
from pydantic_settings import BaseSettings, PydanticBaseSettingsSource, SettingsConfigDict, TomlConfigSettingsSource

from schemas.protocols import PROTOCOLS, Protocol


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
    validation_part: bool = Field(False, description="70 / 10 / 20 % with a validation part instead of 80 / 20 %")
    split_seed: int = Field(0, ge=0, description="seed of the split's search")

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

    def get_protocol(self) -> Protocol:
        """The protocol with the settings that change it."""
        return replace(PROTOCOLS[self.protocol], min_future_s=self.min_future_s)
