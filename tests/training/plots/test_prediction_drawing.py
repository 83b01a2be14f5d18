"""The drawing's structure: what is on it, what its key names, and files of it that viewers can open."""

import struct
import xml.etree.ElementTree as ET
from dataclasses import replace
from itertools import pairwise

import pytest
from drawn_moment import OWN, OWN_SAMPLE, open_moment, sure

from tracklake.training.plots.charts import Tables
from tracklake.training.plots.drawing import draw_picture
from tracklake.training.plots.forecasts import forecast_samples, forecast_scene
from tracklake.training.plots.key import MODEL_COLOURS, draw_key, list_entries
from tracklake.training.plots.picture import take_picture
from tracklake.training.plots.rows import choose_view
from tracklake.training.runs.forecasters import open_forecaster

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return open_moment(tmp_path_factory.mktemp("moment"))


def draw(folder, *models):
    said = forecast_samples(folder, [OWN_SAMPLE], models)[OWN_SAMPLE]
    return take_picture(folder, OWN_SAMPLE, {OWN: said})


@pytest.fixture(scope="module")
def straight(folder):
    return open_forecaster("constant-velocity", folder, folder.path, frozenset({"eval"}))


@pytest.fixture(scope="module")
def picture(folder, straight):
    return draw(folder, straight, sure())


@pytest.fixture(scope="module")
def everybody(folder):
    return take_picture(folder, OWN_SAMPLE, forecast_scene(folder, OWN_SAMPLE, [sure()]))


@pytest.fixture(scope="module")
def drawing(picture):
    return draw_picture(picture)


@pytest.fixture(scope="module")
def svg(drawing):
    return drawing.render(".svg").decode()


def names_of(picture):
    return [row["told"] for row in list_entries(picture, choose_view(picture))]


def texts_of(svg):
    """The lines of text in their order."""
    return [line for found in ET.fromstring(svg).iter(f"{SVG}text") for line in found.itertext()]


def test_the_svg_says_what_is_drawn_and_fetches_nothing(svg):
    texts = texts_of(svg)
    for text in (
        "highd b, vehicle 1 at 1.0 s (sample 0, eval)",
        "true maneuver: left, normal",
        "sure: keep 50%, left 38%, right 12%, normal 75%, brake 25%",
        "direction of travel",
        "lane 1",
        "lane 2",
        "along the road (m)",
        "75%",
        "25%",
        "constant-velocity",
        "seconds ahead",
        "distance from the truth (m)",
    ):
        assert text in texts, texts
    assert any("stretched" in text for text in texts)
    assert "lanes of 12 ft, as no markings are known" not in texts
    assert "href" not in svg
    assert svg.count("http") == svg.count("http://www.w3.org/"), "names of XML, no addresses"


def test_the_same_picture_gives_the_same_bytes(picture, svg):
    assert draw_picture(picture).render(".SVG").decode() == svg
    assert 'id="clip0"' in svg


def test_a_png_is_twice_as_large_and_begins_as_one(drawing, svg):
    png = drawing.render(".png")
    assert png.startswith(b"\x89PNG\r\n\x1a\n")
    width, height = struct.unpack(">II", png[16:24])
    drawn = ET.fromstring(svg)
    assert (width, height) == (2 * int(drawn.get("width")), 2 * int(drawn.get("height")))
    assert 1100 < int(drawn.get("width")) < 1300


def test_other_files_are_not_drawn(drawing):
    with pytest.raises(ValueError, match=r"expected a file whose name ends in \.svg or \.png, got `\.pdf`"):
        drawing.render(".pdf")


def test_layers_show_the_rows(drawing):
    """Vehicle 5 at 100 m is beyond the view of what is drawn of vehicle 1."""
    tables = drawing.to_vega_lite()["datasets"]
    assert len(tables["markings"]) == 3
    assert [row["vehicle_id"] for row in tables["boxes"]] == [1, 2]
    assert len(tables["predictions"]) == 2 * 5
    assert len(tables["ellipses"]) == 2 * 2 * 48
    assert len(tables["errors"]) == 2 * 4
    assert {(row["model"], row["colour"], row["shape"]) for row in tables["predictions"]} == {
        ("constant-velocity", MODEL_COLOURS[0], "circle"),
        ("sure", MODEL_COLOURS[1], "square"),
    }


def test_all_vehicles_of_a_moment_are_drawn(everybody):
    drawing = draw_picture(everybody)
    tables = drawing.to_vega_lite()["datasets"]
    assert len({row["ellipse"] for row in tables["ellipses"]}) == 2 * 2 + 2
    assert [(row["vehicle_id"], row["fill"] == "transparent") for row in tables["boxes"]] == [
        (1, False),
        (2, False),
        (5, True),
    ]
    assert drawing.render(".svg").startswith(b"<svg")


def test_the_key_names_what_is_there_and_nothing_else(picture, everybody, folder, straight):
    said = ["sure", "1 and 3 sigma at each second", "less probable, with probability"]
    near = ["vehicle 1", "neighbor in its grid"]
    assert names_of(picture) == [*near, "history", "truth", "constant-velocity", *said]
    others = ["sure", "1 and 3 sigma at each second, of others 3", said[2]]
    assert names_of(everybody) == [*near, "other vehicle", "size unknown", "history", "truth", *others]
    assert names_of(draw(folder, straight)) == [*near, "history", "truth", "constant-velocity"]
    alone = replace(picture, vehicles=picture.vehicles[:1])
    assert names_of(alone) == ["vehicle 1", "history", "truth", "constant-velocity", *said]


def test_entries_of_the_key_do_not_overlap(everybody):
    rows = draw_key_of(everybody)
    assert rows[-1]["line"] > 0
    for before, after in pairwise(rows):
        assert after["line"] > before["line"] or after["x"] > before["text_x"] + 6 * len(before["told"])
        assert after["text_x"] + 6 * len(after["told"]) < 700


def draw_key_of(picture):
    tables = Tables()
    draw_key(tables, picture, choose_view(picture), 700)
    return tables.rows["key"]


def test_lanes_that_nobody_marked_are_said_to_be_nominal_and_names_are_no_markup(tmp_path):
    picture = draw(open_moment(tmp_path, markings=None), sure("<b>&amp; ${datum.x}"))
    texts = texts_of(draw_picture(picture).render(".svg"))
    assert "lanes of 12 ft, as no markings are known" in texts
    assert "<b>&amp; ${datum.x}" in texts


def test_more_models_than_can_be_told_apart(folder):
    models = [sure(f"model {number}") for number in range(5)]
    with pytest.raises(ValueError, match="shows 1 to 4 models, got 5: model 0"):
        draw_picture(draw(folder, *models))
    with pytest.raises(ValueError, match="shows 1 to 4 models, got 0"):
        draw_picture(draw(folder))
