"""Tables of docs/reconstruction.md."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tracklake.schemas.arrays import Floats
from tracklake.schemas.files import write_file

RECORDED, OURS, OURS_TUNED, TRUTH = "recorded values", "tracklake", "tracklake, tuned", "truth"
"""Names of methods that the text speaks of."""
COLUMNS = {
    "position": ("position, m", "{:.3f}"),
    "speed": ("speed, m/s", "{:.3f}"),
    "accel": ("acceleration, m/s²", "{:.3f}"),
    "steady_accel": ("steady acceleration, m/s²", "{:.3f}"),
    "jerk_changes": ("jerk sign changes, 1/s", "{:.2f}"),
    "gap": ("gap, m", "{:.3f}"),
    "travel_time": ("travel time, s", "{:.3f}"),
    "overlaps": ("false overlaps", "{:.2%}"),
    "backward": ("backward", "{:.2%}"),
    "out_of_bounds": ("out of bounds", "{:.2%}"),
}
"""Measures, how they are headed, and how they are printed."""
SUMMARIES = {"speed": "RMSE of speed, m/s", "accel": "RMSE of acceleration, m/s²"}
"""Measures that are printed with intervals, and by which methods are called better; headings of their summaries."""


@dataclass(frozen=True)
class Comparison:
    """Results of all methods under one noise model at one frame rate; by method and measure.

    Args:
        values: one number each, in arrays of one.
        draws: one number per draw of the bootstrap; draws of different methods are of the same vehicles.
    """

    noise: str
    rate: str
    vehicles: int
    entries: int
    parameters: dict[str, str]
    values: dict[str, dict[str, Floats]]
    draws: dict[str, dict[str, Floats]]

    def find_best_other(self, measure: str) -> str:
        """Name the method of the literature with the least value of a measure."""
        others = [name for name in self.values if name not in (RECORDED, OURS, OURS_TUNED, TRUTH)]
        return min(others, key=lambda name: float(self.values[name][measure][0]))

    def judge(self, measure: str, other: str) -> str:
        """Say whether tracklake is better than another method: only where 95 % of paired differences agree."""
        low, high = np.quantile(self.draws[OURS][measure] - self.draws[other][measure], (0.025, 0.975))
        return "better" if high < 0 else "worse" if low > 0 else "no difference"


def render_comparisons(comparisons: Sequence[Comparison]) -> str:
    """Render a summary per measure, and a table per comparison."""
    parts = []
    for measure in SUMMARIES:
        lines = [
            f"### {SUMMARIES[measure]}",
            "",
            "| rate | noise | recorded | best other method | tracklake | of recorded | against recorded "
            "| against the best |",
            "| --- | --- | --- | --- | --- | --- | --- | --- |",
        ]
        for each in comparisons:
            best = each.find_best_other(measure)
            recorded, other, ours = (float(each.values[name][measure][0]) for name in (RECORDED, best, OURS))
            verdicts = (each.judge(measure, RECORDED), each.judge(measure, best))
            lines.append(
                f"| {each.rate} | {each.noise} | {recorded:.3f} | {other:.3f} ({best}) | {ours:.3f} | "
                f"{ours / recorded:.0%} | {verdicts[0]} | {verdicts[1]} |"
            )
        parts.append("\n".join(lines))
    return "\n\n".join([*parts, *(_render_table(each) for each in comparisons)])


def _render_table(each: Comparison) -> str:
    lines = [
        f"### {each.noise[0].upper()}{each.noise[1:]} noise at {each.rate}",
        "",
        f"{each.vehicles:,} vehicles, {each.entries:,} entries.",
        "",
        "| method | parameters | " + " | ".join(head for head, _ in COLUMNS.values()) + " |",
        "| --- | --- |" + " --- |" * len(COLUMNS),
    ]
    for name, values in each.values.items():
        cells = []
        for key, (_, form) in COLUMNS.items():
            text = form.format(values[key][0])
            if key in SUMMARIES and name != TRUTH:
                low, high = np.quantile(each.draws[name][key], (0.025, 0.975))
                text += f" ({form.format(low)} to {form.format(high)})"
            cells.append(text)
        lines.append(f"| {name} | {each.parameters[name]} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def replace_tables(page: Path, part: str, text: str) -> None:
    """Replace what stands between the marks of a part of the page."""
    begin, end = f"<!-- begin {part} -->\n", f"<!-- end {part} -->\n"
    before, found, rest = page.read_text(encoding="utf-8").partition(begin)
    _, ended, after = rest.partition(end)
    if not found or not ended:
        raise ValueError(f"{page}: expected the lines {begin.strip()} and {end.strip()}")
    write_file(page, f"{before}{begin}\n{text}\n\n{end}{after}".encode())
