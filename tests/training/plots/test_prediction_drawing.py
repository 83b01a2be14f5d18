"""The drawing's structure: what is on it, what its key names, and files of it that viewers can open."""

import struct
import xml.etree.ElementTree as ET
from dataclasses import replace

import pytest
from drawn_moment import OWN, OWN_SAMPLE, open_moment, sure

from tracklake.schemas.errors import UsageError
from tracklake.training.plots.picture import forecast_samples, forecast_scene, take_picture
from tracklake.training.plots.picture_drawing import MODEL_COLOURS, MODEL_SHAPES, describe_marks, draw_picture
from tracklake.training.plots.picture_rows import choose_view
from tracklake.training.runs.forecasters import open_forecaster

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return open_moment(tmp_path_factory.mktemp("moment"))


def draw(folder, *models):
    forecasts = forecast_samples(folder, [OWN_SAMPLE], models)[OWN_SAMPLE]
    return take_picture(folder, OWN_SAMPLE, {OWN: forecasts})


@pytest.fixture(scope="module")
def straight(folder):
    return open_forecaster("constant-velocity", folder, folder.path, frozenset({"eval"}))


@pytest.fixture(scope="module")
def picture(folder, straight):
    return draw(folder, straight, sure())


@pytest.fixture(scope="module")
def whole_scene(folder):
    return take_picture(folder, OWN_SAMPLE, forecast_scene(folder, OWN_SAMPLE, [sure()]))


@pytest.fixture(scope="module")
def drawing(picture):
    return draw_picture(picture)


@pytest.fixture(scope="module")
def svg(drawing):
    return drawing.render(".svg").decode()


def legend_of(picture):
    """The legend's names, in their order; and the line on other marks."""
    svg = ET.fromstring(draw_picture(picture).render(".svg"))
    labels = [group for group in svg.iter(f"{SVG}g") if "role-legend-label" in group.get("class", "")]
    names = [text for group in labels for text in texts_of(ET.tostring(group))]
    return names, describe_marks(picture, choose_view(picture))


def texts_of(svg):
    """The lines of text in their order."""
    return [line for found in ET.fromstring(svg).iter(f"{SVG}text") for line in found.itertext()]


def test_the_svg_says_what_is_drawn_and_fetches_nothing(svg):
    texts = texts_of(svg)
    for text in (
        "highd b, vehicle 1 at 1.0 s (sample 0, eval)",
        "true maneuver: left, normal",
        "sure: keep 50%, left 38%, right 12%, normal 75%, brake 25%",
        "lane 1",
        "lane 2",
        "along the road (m), direction of travel \N{RIGHTWARDS ARROW}",
        "75%",
        "25%",
        "constant-velocity",
        "seconds ahead",
        "distance from the truth (m)",
    ):
        assert text in texts, texts
    assert any("stretched" in text for text in texts)
    assert not any("lanes of 12 ft" in text for text in texts)
    assert "href" not in svg
    assert svg.count("http") == svg.count("http://www.w3.org/"), "names of XML, no addresses"


@pytest.mark.usefixtures("convert_again")
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
    with pytest.raises(UsageError, match=r"expected a file whose name ends in \.svg or \.png, got `\.pdf`"):
        drawing.render(".pdf")


def test_layers_show_the_rows(drawing):
    """Vehicle 5 at 100 m is beyond the view of what is drawn of vehicle 1."""
    tables = drawing.to_vega_lite()["datasets"]
    assert len(tables["markings"]) == 3
    assert [row["vehicle_id"] for row in tables["boxes"]] == [1, 2]
    assert [row["series"] for row in tables["paths"] if row["kind"] == "prediction"] == (
        ["constant-velocity"] * 5 + ["sure"] * 5
    )
    assert len(tables["ellipses"]) == 2 * 2 * 48
    assert len(tables["errors"]) == 2 * 4
    assert [row["label"] for row in tables["probabilities"]] == ["75%", "25%"]


def test_models_have_the_same_colour_and_shape_on_the_road_and_in_errors(drawing):
    def find_scales(part, channel):
        """The scales of a channel in any layer, as pairs of name and mark."""
        if isinstance(part, list):
            return [scale for each in part for scale in find_scales(each, channel)]
        if not isinstance(part, dict):
            return []
        own = part.get("encoding", {}).get(channel, {}).get("scale")
        found = [dict(zip(own["domain"], own["range"], strict=True))] if own else []
        return found + [
            scale for key, each in part.items() if key != "datasets" for scale in find_scales(each, channel)
        ]

    specification = drawing.to_vega_lite()
    for channel, marks in (("stroke", MODEL_COLOURS), ("fill", MODEL_COLOURS), ("shape", MODEL_SHAPES)):
        scales = find_scales(specification, channel)
        assert len(scales) > 3
        for scale in scales:
            assert [scale[model] for model in ("constant-velocity", "sure")] == list(marks[:2])


def test_all_vehicles_of_a_scene_are_drawn(whole_scene):
    drawing = draw_picture(whole_scene)
    tables = drawing.to_vega_lite()["datasets"]
    assert len({row["ellipse"] for row in tables["ellipses"]}) == 2 * 2 + 1, "one of the other vehicle"
    assert [(row["vehicle_id"], row["known"]) for row in tables["boxes"]] == [(1, True), (2, True), (5, False)]
    assert drawing.render(".svg").startswith(b"<svg")


def test_the_legend_names_only_present_marks(picture, whole_scene, folder, straight):
    ellipses, thin = "ellipses: 1 and 3 sigma at each second", "thin lines: less probable, with probability"
    near = ["vehicle 1", "neighbor in its grid"]
    assert legend_of(picture) == ([*near, "history", "truth", "constant-velocity", "sure"], [f"{ellipses}; {thin}"])
    names, [marks] = legend_of(whole_scene)
    assert names == [*near, "other vehicle", "history", "truth", "sure"]
    assert marks == f"{ellipses}, of others 3 at the last; {thin}; outlined vehicle: size unknown"
    assert legend_of(draw(folder, straight)) == ([*near, "history", "truth", "constant-velocity"], [])
    alone = replace(picture, vehicles=picture.vehicles[:1])
    assert legend_of(alone)[0] == ["vehicle 1", "history", "truth", "constant-velocity", "sure"]


def test_long_names_of_models_stand_whole_in_the_legend_within_the_drawing(folder):
    names = [f"attention-h4-ngsim-5s-learning-rate-0.001-seed-{number}" for number in range(4)]
    picture = draw(folder, *map(sure, names))
    assert legend_of(picture)[0][-4:] == names
    assert int(ET.fromstring(draw_picture(picture).render(".svg")).get("width")) < 1300


def test_lanes_without_markings_are_named_nominal_and_names_are_no_markup(tmp_path):
    picture = draw(open_moment(tmp_path, markings=None), sure("<b>&amp; ${datum.x}"))
    texts = texts_of(draw_picture(picture).render(".svg"))
    assert any("lanes of 12 ft, as no markings are known" in text for text in texts)
    assert "<b>&amp; ${datum.x}" in texts


def test_more_models_than_colours_are_refused(folder):
    models = [sure(f"model {number}") for number in range(5)]
    with pytest.raises(UsageError, match="shows 1 to 4 models, got 5: model 0"):
        draw_picture(draw(folder, *models))
    with pytest.raises(UsageError, match="shows 1 to 4 models, got 0"):
        draw_picture(draw(folder))
