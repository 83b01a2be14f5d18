"""A page taken apart, which fails where it is not well formed; and texts that would break one."""

import re
from html.parser import HTMLParser
from pathlib import Path

import tracklake.quality_reports.pages

SCRIPT = Path(tracklake.quality_reports.pages.__file__).parents[1] / "templates" / "report.js"
DRAWING = [SCRIPT.with_name(name) for name in ("canvas.js", "player.js", "diagrams.js")]
DATA = re.compile(r'<script type="application/json" id="(?:scene|tracks)">[^<]*</script>')

HOSTILE = "\"'><script>alert(1)</script><img src=x onerror=alert(2)>&amp;\u202e"


class Elements(HTMLParser):
    """Collects every element and whether the page is well nested."""

    VOID = frozenset({"meta", "br", "img", "link", "input", "hr"})

    def __init__(self) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag


def drop_script(html: str) -> str:
    """The page without the script that every page has, and without those of pictures and their data."""
    for path in (SCRIPT, *DRAWING):
        block = f"<script>\n{path.read_text(encoding='utf-8')}\n</script>"
        assert html.count(block) == 1 if path == SCRIPT else html.count(block) <= 1
        html = html.replace(block, "")
    return DATA.sub("", html)


def parse(html: str) -> Elements:
    parser = Elements()
    parser.feed(drop_script(html))
    parser.close()
    assert parser.open == []
    return parser


def spoil_texts(lake: dict[str, list[dict]]) -> dict[str, list[dict]]:
    """A lake with every text a hostile one, except those that the schemas restrict."""
    keep = {"dataset", "part", "severity", "rule", "method", "lateral_maneuver", "longitudinal_maneuver"}

    def spoil(value):
        if isinstance(value, str):
            return HOSTILE + value
        if isinstance(value, list):
            return [spoil(each) for each in value]
        if isinstance(value, dict):
            return {key: each if key in keep else spoil(each) for key, each in value.items()}
        return value

    return {name: [spoil(each) for each in rows] for name, rows in lake.items()}
