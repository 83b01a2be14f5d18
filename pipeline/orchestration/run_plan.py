"""What there is to do, decided from the manifest before any orchestrator is imported."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from tracklake.pipeline.ingest import ingest, removal
from tracklake.pipeline.ingest.discovery import Digests, Discovery, discover
from tracklake.pipeline.lake import Commit, LakeError, LakeMissingError, Manifest, Writer, load, open_for_writing
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.registry import STAGES
from tracklake.pipeline.stages.stage import Job, Stage, pending
from tracklake.quality_reports.rules.registry import RULES, resolve

INGEST = "ingest"
ALL_STEPS = (INGEST, *(stage.name for stage in STAGES))
QUALITY_STEPS = ("validate", "repair", "assess", "report")


@dataclass(frozen=True)
class RunRequest:
    """What a user asked for: plain values, fit to be a flow's parameters.

    Args:
        lake: folder of the lake.
        steps: of ALL_STEPS, in order.
        source: raw file or folder; needed for ingest.
        dataset: read the source's files as this dataset's only.
        settings: of `pipeline.settings.Settings`, as plain values.
        replace: whether recordings may lose rows of files that the source does not hold.
        prune: remove recordings whose files once stood in the source, a folder, and are gone from it.
        rebuild: begin the lake anew, whatever schema version it is of.
    """

    lake: str
    steps: Sequence[str]
    source: str | None = None
    dataset: str | None = None
    settings: dict[str, Any] = field(default_factory=dict)
    replace: bool = False
    prune: bool = False
    rebuild: bool = False

    @property
    def root(self) -> Path:
        """The lake's folder."""
        return Path(self.lake)

    @property
    def origin(self) -> Path:
        """The source with the links in its path followed: by this the lake remembers where files stood.

        A file that is a link itself keeps the name it was given by.
        """
        given = Path(self.source or "")
        return given.resolve() if given.is_dir() else given.parent.resolve() / given.name

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
        """The stages after ingestion that are asked for; with the report, the pages that it leads to."""
        wanted = {*self.steps, *({"pages"} if "report" in self.steps else ())}
        return [stage for stage in STAGES if stage.name in wanted]


@dataclass
class RunResult:
    """What a run did with a request.

    Args:
        built: recordings (or 1 for a stage over the whole lake) made, by step.
        refused: messages about files and recordings that could not be used.
        failed: messages about work that broke off unexpectedly.
        notes: what the user should know about what was made.
        skipped: files of the source that are no raw data.
        removed: recordings (`dataset/recording`) whose tables were removed.
    """

    built: dict[str, int] = field(default_factory=dict)
    refused: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    removed: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class IngestPlan:
    """What a source means for the lake.

    Args:
        jobs: that are not done.
        conflicts: messages about recordings that would lose rows of other files.
        gone: entries whose files once stood in the source and are gone from it.
        superseded: entries that a new version of their file makes void.
        moved: entries that stay, with the places where their files stand now.
    """

    jobs: list[Job]
    conflicts: list[str]
    gone: list[Commit]
    superseded: list[Commit]
    moved: list[Commit]


def survey(request: RunRequest) -> Discovery:
    """Find the raw files of an order; their hashes are remembered in the lake.

    Raises:
        tracklake.pipeline.sources.SourceError: nothing there.
    """
    if request.source is None:
        raise ValueError("an order to ingest needs a source")
    digests = Digests(request.root)
    discovery = discover(request.origin, dataset=request.dataset, digest=digests)
    digests.save()
    return discovery


def is_idle(request: RunRequest, discovery: Discovery | None) -> bool:
    """Whether everything that was asked for is in the lake already, and nothing else that was asked to go."""
    if request.rebuild:
        return False
    try:
        manifest = load(request.root)
    except LakeMissingError:
        return False
    if discovery is not None:
        if ingest.files_to_read(discovery, manifest):
            return False
        plan = plan_ingest(request, discovery, manifest)
        if plan.jobs or plan.superseded or (request.prune and plan.gone):
            return False
    return not any(
        any(outstanding(stage, request.root, manifest, request.get_settings())) for stage in request.stages()
    )


def conclude_idle(request: RunRequest, discovery: Discovery | None) -> RunResult:
    """What there is to say where nothing is to do; the lake learns where files stand that were moved."""
    if discovery is None:
        return RunResult()
    plan = plan_ingest(request, discovery, load(request.root))
    if plan.moved:
        with suppress(LakeError), open_for_writing(request.root) as writer:  # where it is busy, the next run will do
            remember_places(writer, request, plan)
    return RunResult(refused=[*discovery.refusals, *plan.conflicts], notes=explain_gone(plan))


def plan_ingest(request: RunRequest, discovery: Discovery, manifest: Manifest) -> IngestPlan:
    """Compare a source with the lake."""
    planned = ingest.plan(discovery, manifest)
    jobs = pending(request.root, manifest, planned)
    folder = removal.Folder(request.origin, discovery)
    conflicts = {} if request.replace else ingest.find_replaced(jobs, manifest)
    for job in jobs:
        if job.key in conflicts and all(map(folder.lost, ingest.find_lost(job, manifest.commits[job.key]))):
            conflicts[job.key] += " So does --prune, where files are gone from SOURCE, as here."
            if request.prune:
                del conflicts[job.key]
    superseded = removal.find_superseded(discovery, manifest)
    gone = removal.find_gone(folder, planned, manifest, request.dataset)
    return IngestPlan(
        jobs=[job for job in jobs if job.key not in conflicts],
        conflicts=sorted(conflicts.values()),
        gone=[entry for entry in gone if entry not in superseded],
        superseded=superseded,
        moved=[
            replace(entry, built_from={**entry.built_from, "sources": job.built_from["sources"]})
            for job, entry in removal.find_moved(planned, manifest)
            if job not in jobs
        ],
    )


def remember_places(writer: Writer, request: RunRequest, plan: IngestPlan) -> None:
    """Let the lake know where the raw files of its recordings are."""
    writer.remember_origin(str(request.origin))
    for entry in plan.moved:
        writer.commit(entry)


def prune(writer: Writer, request: RunRequest, plan: IngestPlan, result: RunResult) -> None:
    """Remove what a new version of its file makes void, and what was made of files that are gone, where asked to."""
    gone = plan.gone if request.prune else []
    removed = removal.describe(gone, writer.manifest)
    writer.remove(removal.keys_made_of([*plan.superseded, *gone], writer.manifest))
    result.removed += [recording.name for recording in removed]
    if gone:
        rows = sum(recording.entries for recording in removed)
        result.notes.append(
            f"{removal.name_all(gone)}: no longer in SOURCE, and removed from the lake ({rows:,} rows of tracks)"
        )
    else:
        result.notes += explain_gone(plan)


def explain_gone(plan: IngestPlan) -> list[str]:
    """Say which recordings are in the lake although their files are gone."""
    if not plan.gone:
        return []
    name = removal.name_all(plan.gone)
    many = not name.startswith("recording ")
    are, their = ("are", "their") if many else ("is", "its")
    return [f"{name} {are} in the lake, but {their} files are no longer in SOURCE; --prune removes {their} tables"]


def explain_not_rebuilt(before: set[str], manifest: Manifest) -> list[str]:
    """Say which recordings a lake held before it was begun anew, and does not hold now."""
    missing = sorted(before - {entry.key.partition("/")[2] for entry in manifest.of_stage(INGEST)})
    if not missing:
        return []
    return [
        f"{', '.join(missing)}: in the lake before it was rebuilt, and not in it now; "
        "`tracklake run` on the files of these adds them"
    ]


def outstanding(stage: Stage, root: Path, manifest: Manifest, settings: Settings) -> tuple[list[Job], set[str]]:
    """The jobs of a stage that are not done, and keys of entries it made once and would not make now.

    Raises:
        StageError: an earlier stage has to run first.
    """
    jobs = stage.plan(root, manifest, settings)
    stale = {entry.key for entry in manifest.of_stage(stage.name)} - {job.key for job in jobs}
    return pending(root, manifest, jobs), stale


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
