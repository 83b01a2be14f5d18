"""Attention maps: the vehicles, the weights that are drawn, and files that fetch nothing."""

import json
import re
from dataclasses import dataclass, replace

import numpy as np
import pytest
from drawn_moment import FAR, FAR_SAMPLE, NEAR, OWN, OWN_SAMPLE, open_moment

from tracklake.training.plots.attention import (
    choose_extent,
    describe_head,
    draw_attention,
    list_bands,
    list_boxes,
    list_weights,
    map_attention,
)

HEADS = 2


@dataclass
class Weights:
    vehicles: np.ndarray
    lanes: np.ndarray
    decoder: np.ndarray


class KnownAttention:
    """Weights that are known: in head h vehicle v gives u (h + 1) (u + 1) parts, the lanes 1, 2, 3 parts."""

    lanes = "adjacent"

    def choose_lanes(self, observed):
        return observed.lanes

    def read_attention(self, observed):
        there, exists = observed.vehicle_mask, observed.lanes[..., 2] > 0
        scenes, vehicles = there.shape
        parts = np.zeros((scenes, HEADS, vehicles, vehicles), np.float32)
        lanes = np.zeros((scenes, HEADS, vehicles, 3), np.float32)
        for head in range(HEADS):
            parts[:, head] = ((np.arange(vehicles) + 1.0) ** (head + 1) * there)[:, None, :]
            lanes[:, head] = (np.array([1.0, 2.0, 3.0]) * exists)[:, None, :]
        parts /= parts.sum(axis=-1, keepdims=True)
        lanes /= np.maximum(lanes.sum(axis=-1, keepdims=True), 1)
        return Weights(parts, lanes, parts[:, ::-1])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return open_moment(tmp_path_factory.mktemp("moment"))


@pytest.fixture(scope="module")
def shown(folder):
    return map_attention(folder, KnownAttention(), [OWN_SAMPLE])[0]


def test_vehicles_are_the_ego_and_the_nearest_that_are_there(folder, shown):
    """The ego in (20, 6), vehicle 2 in (25, 2), vehicle 5 in (100, 2); lane 2 of two lanes of 4 m."""
    assert shown.vehicle_id == (OWN, NEAR, FAR)
    assert shown.names == ["ego", "1", "2"]
    assert shown.place_m.tolist() == [[0, 0], [5, -4], [80, -4]]
    assert shown.lanes.tolist() == [[-4, 4, 1], [0, 4, 1], [0, 0, 0]]
    assert (shown.heads, shown.vehicles.shape, shown.to_lanes.shape) == (2, (2, 3, 3), (2, 3, 3))
    assert shown.vehicles[0, 1].tolist() == pytest.approx([1 / 6, 2 / 6, 3 / 6])
    assert shown.decoder[0, 1].tolist() == pytest.approx([1 / 14, 4 / 14, 9 / 14])
    assert shown.to_lanes[1, 2].tolist() == pytest.approx([1 / 3, 2 / 3, 0])
    own, far = map_attention(folder, KnownAttention(), [OWN_SAMPLE, FAR_SAMPLE], nearest=1)
    assert (own.vehicle_id, far.vehicle_id) == ((OWN, NEAR), (FAR, NEAR))
    assert far.picture.sample == FAR_SAMPLE


def test_the_table_holds_the_numbers(shown):
    table = json.loads(json.dumps(shown.to_dict(), allow_nan=False))
    assert (table["subset"], table["time_s"], table["lateral"], table["heads"]) == ("b", 1.0, "left", 2)
    assert [one["vehicle_id"] for one in table["vehicles"]] == [OWN, NEAR, FAR]
    assert table["vehicles"][1] == {
        **{"name": "1", "vehicle_id": NEAR, "along_m": 5.0, "across_m": -4.0},
        **{"length_m": 4.2, "width_m": 1.52},
    }
    assert (table["vehicles"][2]["length_m"], table["vehicles"][2]["width_m"]) == (None, None)
    assert [one["exists"] for one in table["lanes"]] == [True, True, False]
    assert table["attention"]["encoder_vehicles"][0][2] == [0.166667, 0.333333, 0.5]
    assert table["attention"]["decoder_vehicles"][1][0] == [0.166667, 0.333333, 0.5]
    assert table["attention"]["encoder_lanes"][0][0] == [0.333333, 0.666667, 0.0]


def test_what_is_drawn_of_a_head(shown):
    assert describe_head(shown, 0) == (
        "the ego attends most to vehicle 2 (50%) and the own lane (67%); in the decoder to vehicle 2 (64%)"
    )
    itself = np.zeros_like(shown.vehicles)
    itself[:, :, 0] = 1
    alone = replace(shown, vehicles=itself, decoder=itself, to_lanes=0 * shown.to_lanes)
    assert describe_head(alone, 1) == (
        "the ego attends most to itself (100%) and no lane, as none is known; in the decoder to itself (100%)"
    )
    assert [(row["lane"], row["left_m"], row["right_m"], row["label"]) for row in list_bands(shown, 0)] == [
        ("left", -6, -2, "left (33%)"),
        ("own", -2, 2, "own (67%)"),
    ]
    own, near, far = list_boxes(shown, 0)
    assert (own["own"], near["own"]) == (True, False)
    assert (near["front_m"], near["back_m"]) == pytest.approx((5, 0.8))
    assert (near["left_m"], near["right_m"]) == pytest.approx((-4.76, -3.24))
    assert far["front_m"] - far["back_m"] == pytest.approx(4.5), "of unknown size"
    assert [box["label"] for box in (own, near, far)] == ["ego (17%)", "1 (33%)", "2 (50%)"]
    weights = {(row["matrix"], row["by"], row["to"]): row["weight"] for row in list_weights(shown, 0)}
    assert len(weights) == 9 + 3 * 2 + 9
    assert weights["vehicles", "1", "2"] == pytest.approx(3 / 6)
    assert weights["decoder", "2", "ego"] == pytest.approx(1 / 14)
    assert weights["lanes", "ego", "own"] == pytest.approx(2 / 3)
    assert ("lanes", "ego", "right") not in weights, "a lane that does not exist"
    (first, last), (top, bottom) = choose_extent(shown)
    assert (first, last) == pytest.approx((-4.1 - 6, 80 + 6))  # 5 % of 84.1 m are less than 6 m
    assert (top, bottom) == pytest.approx((-6 - 2.5, 2 + 2.5))  # the markings at 0, 4 and 8 m, the ego at 6 m


@pytest.mark.usefixtures("convert_again")
def test_the_same_map_gives_the_same_bytes(shown):
    assert draw_attention(shown).render(".svg") == draw_attention(shown).render(".svg")


def test_drawings_name_every_head_and_fetch_nothing(shown):
    drawn = draw_attention(shown)
    svg = drawn.render(".svg").decode()
    assert not re.search(r"(href|src|@import|url\()[^>]*http", svg)
    for words in ("head 1", "head 2", "vehicle 1 of highd b", "encoder: vehicles", "decoder: vehicles", "2 (50%)"):
        assert words in svg
    assert drawn.render(".png").startswith(b"\x89PNG")
    assert len(drawn.to_vega_lite()["datasets"]["weights"]) == HEADS * (9 + 6 + 9)
