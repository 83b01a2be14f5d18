"""What there is to do, decided from the manifest before any orchestrator is imported."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.lake import LakeMissingError, Manifest, load
from pipeline.settings import Settings
from pipeline.stages import ingest
from pipeline.stages.base import Job, Stage, pending
from pipeline.stages.discovery import Digests, Discovery, discover
from pipeline.stages.registry import STAGE_BY_NAME, STAGES
from quality_reports.rules import RULES, resolve

INGEST = "ingest"
ALL_STEPS = (INGEST, *(stage.name for stage in STAGES))
QUALITY_STEPS = ("validate", "repair", "report")


@dataclass(frozen=True)
class Order:
    """What a user asked for: plain values, fit to be a flow's parameters.

    Args:
        lake: folder of the lake.
        steps: of ALL_STEPS, in order.
        source: raw file or folder; needed for ingest.
        dataset: read the source's files as this dataset's only.
        settings: of `pipeline.settings.Settings`, as plain values.
        replace: whether recordings may lose rows of files that the source does not hold.
    """

    lake: str
    steps: Sequence[str]
    source: str | None = None
    dataset: str | None = None
    settings: dict[str, Any] = field(default_factory=dict)
    replace: bool = False

    @property
    def root(self) -> Path:
        """The lake's folder."""
        return Path(self.lake)

    def get_settings(self) -> Settings:
        """The settings, validated."""
        return Settings(**self.settings)

    def check(self) -> None:
        """Refuse settings that only a later stage would stumble over.

        Raises:
            ThresholdError: a threshold of no such name.
        """
        resolve(RULES, self.get_settings().thresholds)

    def stages(self) -> list[Stage]:
        """The stages after ingestion that are asked for."""
        return [STAGE_BY_NAME[name] for name in self.steps if name != INGEST]


@dataclass
class Outcome:
    """What came of an order.

    Args:
        built: recordings (or 1 for a stage over the whole lake) made, by step.
        refused: messages about files and recordings that could not be used.
        failed: messages about work that broke off unexpectedly.
        notes: what the user should know about what was made.
        passed_by: files of the source that are no raw data.
    """

    built: dict[str, int] = field(default_factory=dict)
    refused: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    passed_by: list[str] = field(default_factory=list)


def survey(order: Order) -> Discovery:
    """Find the raw files of an order; their hashes are remembered in the lake.

    Raises:
        pipeline.sources.SourceError: nothing there.
    """
    if order.source is None:
        raise ValueError("an order to ingest needs a source")
    digests = Digests(order.root)
    discovery = discover(Path(order.source), dataset=order.dataset, digest=digests)
    digests.save()
    return discovery


def is_idle(order: Order, discovery: Discovery | None) -> bool:
    """Whether everything that was asked for is in the lake already."""
    try:
        manifest = load(order.root)
    except LakeMissingError:
        return False
    if discovery is not None and (
        ingest.files_to_read(discovery, manifest) or any(plan_ingest(order, discovery, manifest))
    ):
        return False
    return not any(outstanding(stage, order.root, manifest, order.get_settings()) for stage in order.stages())


def plan_ingest(order: Order, discovery: Discovery, manifest: Manifest) -> tuple[list[Job], list[str]]:
    """The ingest jobs that are not done, and messages about those that would lose rows of other files."""
    jobs = pending(order.root, manifest, ingest.plan(discovery, manifest))
    conflicts = {} if order.replace else ingest.find_replaced(jobs, manifest)
    return [job for job in jobs if job.key not in conflicts], sorted(conflicts.values())


def outstanding(stage: Stage, root: Path, manifest: Manifest, settings: Settings) -> list[Job]:
    """The jobs of a stage that are not done.

    Raises:
        StageError: an earlier stage has to run first.
    """
    return pending(root, manifest, stage.plan(root, manifest, settings))


def explain_left_out(manifest: Manifest) -> list[str]:
    """Say which subsets took no part in the freeway-only stages, and why."""
    arterials = sorted(
        subset["subset"]
        for entry in manifest.of_stage(INGEST)
        for subset in entry.info["subsets"]
        if not subset["freeway"]
    )
    notes = []
    if arterials:
        notes.append(
            f"repair, samples, split and tensors were left out for {', '.join(arterials)}: those stages are defined "
            "for freeways, and these are directions of arterial streets; tracks, findings, report and SQL are complete"
        )
    return notes
