"""The plan of a run, made from the manifest before any orchestrator is imported."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from tracklake.pipeline.ingest import ingest, removal
from tracklake.pipeline.ingest.discovery import Digests, Discovery, discover
from tracklake.pipeline.lake import (
    Commit,
    LakeError,
    LakeMissingError,
    Manifest,
    Writer,
    is_settled,
    load,
    open_for_writing,
)
from tracklake.pipeline.lake.object_store import find_address
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.sources.column_mapping import load_mapping
from tracklake.pipeline.stages.planner import Planner, find_pending
from tracklake.pipeline.stages.registry import STAGES
from tracklake.pipeline.stages.stage import INGEST, RECONSTRUCTION, Job, Stage
from tracklake.schemas.errors import UsageError
from tracklake.schemas.extras import find_missing, require_extras
from tracklake.schemas.protocols import RECONSTRUCTED_TRACKS

ALL_STEPS = (INGEST, *(stage.name for stage in STAGES))
"""Every step of `tracklake run`, in order."""
QUALITY_STEPS = ("validate", "repair", "assess", "report")
"""Steps of the flow that checks what is in the lake."""
OPTIONAL_STEPS = (RECONSTRUCTION, "revalidate")
"""Steps that `tracklake run` leaves out where the setting `reconstruct` is false or the extra is not installed."""


@dataclass(frozen=True)
class RunRequest:
    """The request of a user: plain values, fit to be a flow's parameters.

    Args:
        steps: names of ALL_STEPS, in order.
        source: raw file or folder; needed for ingest.
        replace: whether recordings may lose rows of files that the source does not hold.
        prune: remove recordings whose files once stood in the source, a folder, and are missing from it now.
        rebuild: make the whole lake again, whatever its schema version.
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
        """Path of the folder of the lake.

        Raises:
            UsageError: it is on an object store, whose copy in a folder only commands and `tracklake.run` work on.
        """
        address = find_address(self.lake)
        if address is not None:
            raise UsageError(
                f"{address}: a flow works on a lake in a folder. `tracklake run` and `tracklake.run` work in a copy of "
                "this one, and publish it."
            )
        return Path(self.lake)

    @property
    def origin(self) -> Path:
        """The source with the links in its path followed: the lake remembers files by it.

        A file that is a link itself keeps the name it was given by.
        """
        given = Path(self.source or "")
        return given.resolve() if given.is_dir() else given.parent.resolve() / given.name

    def get_settings(self) -> Settings:
        """Return the settings, validated."""
        return Settings(**{**self.settings, "lake": self.lake})

    def check(self) -> None:
        """Refuse paths and missing packages that would only fail in a later stage.

        Raises:
            MissingExtraError: Prefect is not installed, or what a requested step needs is not.
            UsageError: the path of the lake or the source is no UTF-8 text.
        """
        require_extras("the pipeline", "flows", *(("report",) if "report" in self.steps else ()))
        if self.get_settings().tracks_from == RECONSTRUCTED_TRACKS:
            require_extras('tracks_from = "reconstructed"', "reconstruct")
        if RECONSTRUCTION in self.steps and INGEST not in self.steps:
            require_extras("`tracklake reconstruct`", "reconstruct")
        for name, path in (("lake", self.root), ("SOURCE", self.origin)):
            full = str(path.resolve())
            if any(0xD800 <= ord(character) <= 0xDFFF for character in full):
                raise UsageError(
                    f"{name} {full}: the path is no UTF-8 text, which DuckDB and Prefect need. Rename the folder."
                )

    def list_stages(self) -> list[Stage]:
        """Return the requested stages after ingestion; with the report, the pages that it links to."""
        wanted = {*self.steps, *({"pages", "drive_pages"} if "report" in self.steps else ())}
        return [stage for stage in STAGES if stage.name in wanted.difference(self.list_left_out())]

    def list_left_out(self) -> tuple[str, ...]:
        """Return the optional steps that a run leaves out by its settings, or as their extra is not installed."""
        if INGEST not in self.steps or (self.get_settings().reconstruct and not find_missing("reconstruct")):
            return ()
        return tuple(step for step in self.steps if step in OPTIONAL_STEPS)


@dataclass
class RunResult:
    """The result of a run.

    Args:
        built: recordings (or 1 for a stage over the whole lake) made, by step.
        refused: messages about files and recordings that could not be used.
        failed: messages about work that broke off unexpectedly.
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
    """The changes that a source means for the lake.

    Args:
        conflicts: messages about recordings that would lose rows of other files.
        missing: commits whose files once stood in the source and are missing from it now.
        superseded: commits that a new version of their file makes void.
        moved: commits that stay, with the places where their files are now.
        renamed: commits of recordings that the source's files now give under other names.
    """

    manifest: Manifest
    jobs: list[Job]
    conflicts: list[str]
    missing: list[Commit]
    superseded: list[Commit]
    moved: list[Commit]
    renamed: list[Commit]


@dataclass(frozen=True)
class RunPlan:
    """The findings of a command before it starts any work, handed on so that nothing is searched twice.

    Args:
        discovery: the source's raw files; None where nothing is ingested.
        ingest: the source compared with the lake; None where files have to be read first, or there is no lake yet.
        is_idle: whether everything that was requested is in the lake already, and the last session came to its end.
        is_broken_off: whether all is done but the end of a session: it was killed, or the lake was copied or changed.
    """

    discovery: Discovery | None = None
    ingest: IngestPlan | None = None
    is_idle: bool = False
    is_broken_off: bool = False


def survey_source(request: RunRequest) -> Discovery:
    """Find the raw files of a request; their hashes are remembered in the lake.

    Raises:
        ValueError: the request names no source.
        tracklake.pipeline.sources.SourceError: the source holds nothing.
    """
    if request.source is None:
        raise ValueError("a request to ingest needs a source")
    digests = Digests(request.root)
    settings = request.get_settings()
    mapping = None if settings.columns is None else load_mapping(settings.columns)
    discovery = discover(
        request.origin, dataset=request.dataset, digest=digests, mapping=mapping, recording=settings.recording or ""
    )
    digests.save()
    return discovery


def remember_hashes(root: Path, discovery: Discovery) -> None:
    """Store the hashes of a source's files in a lake that may not have existed when they were computed."""
    digests = Digests(root)
    for _, unit in discovery.units:
        for file in unit.files:
            digests(file)
    digests.save()


def plan_run(request: RunRequest, discovery: Discovery | None) -> RunPlan:
    """Compare a request with the lake.

    Raises:
        StageError: a stage that is not requested has to run first.
    """
    if request.rebuild:
        return RunPlan(discovery)
    try:
        manifest = load(request.root)
    except LakeMissingError:
        return RunPlan(discovery)
    plan = None
    if discovery is not None:
        if ingest.find_unread_files(discovery, manifest):
            return RunPlan(discovery)
        plan = plan_ingest(request, discovery, manifest)
        if plan.jobs or plan.superseded or (request.prune and plan.missing):
            return RunPlan(discovery, plan)
    planner = Planner(request.root, manifest, request.get_settings())
    is_done = not any(any(planner.find_outstanding(stage.name)) for stage in request.list_stages())
    is_ended = is_done and is_settled(request.root, manifest)
    return RunPlan(discovery, plan, is_idle=is_ended, is_broken_off=is_done and not is_ended)


def conclude_idle(request: RunRequest, plan: RunPlan) -> RunResult:
    """Return what an idle run has to report; the lake remembers where files that were moved are now."""
    if plan.discovery is None or plan.ingest is None:
        return RunResult()
    if plan.ingest.moved:
        with suppress(LakeError), open_for_writing(request.root) as writer:  # where it is busy, the next run will do
            remember_places(writer, request, plan.ingest)
    refused = [*plan.discovery.refusals, *plan.ingest.conflicts]
    return RunResult(refused=refused, notes=explain_missing(plan.ingest) + explain_renamed(plan.ingest))


def plan_ingest(request: RunRequest, discovery: Discovery, manifest: Manifest) -> IngestPlan:
    """Compare a source with the lake."""
    planned = ingest.plan(discovery, manifest)
    jobs = find_pending(request.root, manifest, planned)
    folder = removal.Folder(request.origin, discovery)
    conflicts = {} if request.replace else ingest.find_replaced(jobs, manifest)
    for job in jobs:
        if job.key in conflicts and all(map(folder.is_lost, ingest.find_lost(job, manifest.commits[job.key]))):
            conflicts[job.key] += " So does --prune, where files are missing from SOURCE, as here."
            if request.prune:
                del conflicts[job.key]
    superseded = removal.find_superseded(discovery, manifest)
    missing = removal.find_missing(folder, planned, manifest, request.dataset)
    return IngestPlan(
        manifest=manifest,
        jobs=[job for job in jobs if job.key not in conflicts],
        conflicts=sorted(conflicts.values()),
        missing=[commit for commit in missing if commit not in superseded],
        superseded=superseded,
        moved=[
            replace(commit, built_from={**commit.built_from, "sources": job.built_from["sources"]})
            for job, commit in removal.find_moved(planned, manifest)
            if job not in jobs
        ],
        renamed=removal.find_renamed(planned, manifest),
    )


def remember_places(writer: Writer, request: RunRequest, plan: IngestPlan) -> None:
    """Record in the lake where the raw files of its recordings are."""
    writer.remember_origin(str(request.origin))
    for commit in plan.moved:
        writer.commit(commit)


def remove_missing(writer: Writer, request: RunRequest, plan: IngestPlan, result: RunResult) -> None:
    """Remove what a new version of its file makes void; with --prune, also what was made of files that are missing."""
    missing = plan.missing if request.prune else []
    removed = removal.describe_removed(missing, writer.manifest)
    writer.remove(removal.find_dependents([*plan.superseded, *missing], writer.manifest))
    result.removed += [recording.name for recording in removed]
    if missing:
        sizes = removal.describe_sizes(removed)
        result.notes.append(
            f"{removal.name_recordings(missing)}: no longer in SOURCE, and removed from the lake ({sizes})"
        )
    else:
        result.notes += explain_missing(plan)
    result.notes += explain_renamed(plan)


def remove_outdated(writer: Writer, request: RunRequest, settings: Settings) -> None:
    """Remove reconstructed tracks of recordings that have changed, where the run does not reconstruct them again."""
    if left_out := request.list_left_out():
        jobs, stale = Planner(writer.root, writer.manifest, settings).find_outstanding(RECONSTRUCTION)
        tails = {job.tail for job in jobs} | {key.partition("/")[2] for key in stale}
        writer.remove({f"{step}/{tail}" for step in left_out for tail in tails})


def explain_missing(plan: IngestPlan) -> list[str]:
    """Return a note about the recordings that are in the lake although their files are missing from the source."""
    if not plan.missing:
        return []
    name = removal.name_recordings(plan.missing)
    many = not name.startswith("recording ")
    are, their = ("are", "their") if many else ("is", "its")
    return [f"{name} {are} in the lake, but {their} files are no longer in SOURCE; --prune removes {their} tables"]


def explain_renamed(plan: IngestPlan) -> list[str]:
    """Return a note about the recordings whose rows are in the lake under other names, too."""
    if not plan.renamed:
        return []
    return [
        f"{removal.name_recordings(plan.renamed)}: made of the same files as other recordings, so that the lake has "
        "these rows twice; `tracklake remove RECORDING` takes them out"
    ]


def explain_not_rebuilt(before: set[str], manifest: Manifest) -> list[str]:
    """Return a note about recordings that a lake held before it was rebuilt, and does not hold now."""
    missing = sorted(before - {commit.tail for commit in manifest.of_stage(INGEST)})
    if not missing:
        return []
    return [
        f"{', '.join(missing)}: in the lake before it was rebuilt, and not in it now; "
        "`tracklake run` on the files of these adds them"
    ]


def explain_not_reconstructed(request: RunRequest) -> list[str]:
    """Return a note where tracks are not reconstructed although no setting says so."""
    if not request.list_left_out() or not request.get_settings().reconstruct:
        return []
    return [
        "tracks were not reconstructed, which needs the extra [reconstruct]: pip install "
        '"tracklake[reconstruct]"; everything else is complete'
    ]


def explain_left_out(manifest: Manifest) -> list[str]:
    """Return a note about the subsets that are left out of the freeway-only stages, and why."""
    arterials = sorted(
        subset["subset"]
        for commit in manifest.of_stage(INGEST)
        for subset in commit.info["subsets"]
        if not subset["freeway"]
    )
    if not arterials:
        return []
    return [
        f"reconstruct, repair, traffic, samples, split and tensors were left out for {', '.join(arterials)}: those "
        "stages are defined for freeways, and these are directions of arterial streets; tracks, findings, report and "
        "SQL are complete"
    ]
