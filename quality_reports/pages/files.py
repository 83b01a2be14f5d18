"""Pages of the source files: rows and hashes, and the rows that were rejected."""

from tracklake.quality_reports.pages.rendering import describe_origins, format_cell, make_environment
from tracklake.quality_reports.summaries import REJECTS_PER_FILE, Row
from tracklake.schemas.quality import IngestedFile, Quality

FILES_PAGE = "files.html"
"""File name of the page of source files, beside the overview."""
REJECTS_PAGE = "rejects.html"
"""File name of the page of rejected rows, beside the overview."""


def render_files(quality: Quality) -> dict[str, str]:
    """Render both pages, by file name; that of rejected rows only where there are some."""
    environment, ingestion = make_environment(), quality["ingestion"]
    rejects_page = REJECTS_PAGE if ingestion["rejects"] else None
    files = environment.get_template("files.html.j2").render(
        files=[list_reasons(row) for row in ingestion["files"]],
        provenance=quality["provenance"],
        rejects_page=rejects_page,
        banner=describe_origins(quality),
    )
    if rejects_page is None:
        return {FILES_PAGE: files}
    rejects = environment.get_template("rejects.html.j2").render(
        rejects=ingestion["rejects"],
        per_file=REJECTS_PER_FILE,
        files_page=FILES_PAGE,
        banner=describe_origins(quality),
    )
    return {FILES_PAGE: files, REJECTS_PAGE: rejects}


def list_reasons(row: IngestedFile) -> Row:
    """Add `reasons` to a file's row: why rows were dropped, and how many for each reason."""
    dropped = row["dropped_by_reason"] or []
    return {**row, "reasons": "; ".join(f"{each['reason']}: {format_cell(each['rows'], 'int')}" for each in dropped)}
