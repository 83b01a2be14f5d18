"""The figure of errors over the horizon: figures by hand, what is refused, and what stands on it."""

import re
import xml.etree.ElementTree as ET

import polars as pl
import pytest
from study_figure import COLUMNS, MOST_MODELS, draw_error_growth, summarise_seeds


def table(*rows):
    return pl.DataFrame(rows, schema=COLUMNS, orient="row")


HAND = table(
    # (model, dataset, seed, seconds, rmse_m), in no order of time
    ("lstm", "NGSIM-like", 0, 0.4, 3.0),
    ("lstm", "NGSIM-like", 0, 0.2, 1.0),
    ("lstm", "NGSIM-like", 1, 0.2, 2.0),
    ("lstm", "NGSIM-like", 1, 0.4, 7.0),
    ("cv", "NGSIM-like", 0, 0.2, 1.5),
    ("cv", "NGSIM-like", 0, 0.4, 1.25),
    ("lstm", "highD-like", 0, 0.2, 0.5),
)


def test_means_and_bands_over_seeds_by_hand():
    """Errors of lstm on an NGSIM-like study: growth 1 then 2 with seed 0, 2 then 5 with seed 1."""
    rows = summarise_seeds(HAND).to_dicts()
    assert [(row["model"], row["dataset"], row["seconds"]) for row in rows] == [
        ("lstm", "NGSIM-like", 0.2),
        ("lstm", "NGSIM-like", 0.4),
        ("cv", "NGSIM-like", 0.2),
        ("cv", "NGSIM-like", 0.4),
        ("lstm", "highD-like", 0.2),
    ]
    figures = [[row[f"{of}_{what}_m"] for what in ("mean", "low", "high")] for row in rows for of in ("rmse", "growth")]
    assert figures == [
        [1.5, 1, 2],
        [1.5, 1, 2],
        [5, 3, 7],
        [3.5, 2, 5],
        [1.5] * 3,
        [1.5] * 3,
        [1.25] * 3,
        [-0.25] * 3,
        [0.5] * 3,
        [0.5] * 3,
    ]


def test_the_figure_names_models_and_data_sets():
    drawing = draw_error_growth(HAND)
    svg = drawing.render(".svg")
    texts = [line for found in ET.fromstring(svg).iter("{http://www.w3.org/2000/svg}text") for line in found.itertext()]
    for text in ("lstm", "cv", "NGSIM-like", "highD-like", "RMSE (m)", "change of RMSE per 0.2 s (m)", "seconds ahead"):
        assert text in texts
    assert "means of 1 to 2 seeds, in bands from the least to the greatest" in texts
    assert drawing.to_vega_lite()["datasets"]["errors"] == summarise_seeds(HAND).to_dicts()
    assert draw_error_growth(HAND).render(".svg") == svg


def measure_bands(svg):
    """Greatest height of each band, in pixels: a path along its upper edge and back along the lower one."""
    heights = []
    for group in ET.fromstring(svg).iter("{http://www.w3.org/2000/svg}g"):
        if "mark-area" in group.get("class", ""):
            for path in group.iter("{http://www.w3.org/2000/svg}path"):
                at = {}
                for x, y in re.findall(r"([-.\d]+),([-.\d]+)", path.get("d")):
                    at.setdefault(x, []).append(float(y))
                heights.append(max(max(own) - min(own) for own in at.values()))
    return heights


def test_models_of_one_seed_have_no_band():
    of_one = draw_error_growth(HAND.filter(pl.col("seed") == 0)).render(".svg")
    assert "of one seed" in of_one.decode()
    assert not any(measure_bands(of_one))
    # Of all seeds, lstm on NGSIM-like alone has more than one: its errors and their growth are bands.
    heights = measure_bands(draw_error_growth(HAND).render(".svg"))
    assert sum(height > 1 for height in heights) == 2


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (HAND.drop("seed"), "expected a column `seed` of Int64, got None"),
        (HAND.with_columns(pl.col("seed").cast(pl.Int32)), "expected a column `seed` of Int64, got Int32"),
        (HAND.clear(), "expected rows, got none"),
        (
            HAND.with_columns(rmse_m=pl.lit(None, pl.Float64)),
            "finite times, and RMSE of 0 or more, got .*'rmse_m': None",
        ),
        (HAND.with_columns(rmse_m=pl.lit(float("nan"))), "RMSE of 0 or more, got .*nan"),
        (HAND.with_columns(rmse_m=pl.lit(-1.0)), "RMSE of 0 or more, got .*-1.0"),
        (pl.concat([HAND, HAND.head(1)]), "expected one row per model, dataset, seed, seconds, got two such"),
        (table(("cv", "a", 0, 0.2, 1.0), ("cv", "a", 0, 0.6, 1.0)), "steps ahead, the same step for all, got .*0.6"),
        (table(("cv", "a", 0, 0.0, 1.0)), "steps ahead, the same step for all, got .*'seconds': 0.0"),
        (table(("cv", "a", 0, 0.2, 1.0), ("lstm", "a", 0, 0.5, 1.0)), "the same step for all, got .*0.5"),
        (
            table(*((f"model {number}", "a", 0, 0.2, 1.0) for number in range(MOST_MODELS + 1))),
            f"at most {MOST_MODELS} models, got {MOST_MODELS + 1}",
        ),
    ],
)
def test_tables_that_would_be_drawn_wrongly_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        draw_error_growth(wrong)
