"""The files under `tensors/<split>/<fingerprint>/`: flat arrays and an index of samples, declared once.

Every array of ARRAYS is a file of its own in NumPy's format, `sample_row.npy`, which `numpy.load(file, mmap_mode="r")`
maps into memory. `index.json` says what they are: INDEX_KEYS.
"""

from dataclasses import dataclass

INDEX_FILE = "index.json"

TENSORS_VERSION = 5
"""Number of the folder's layout; it grows when older readers cannot read the files."""
POSITION_STORAGES = ("float32", "int16-decimetres", "int16-centimetres")

STORAGE = """\
How positions are stored. As int16 they are whole steps from the subset's centre (the median of each axis): along the
road decimetres or centimetres (these reach 327 m either way: longer roads are refused), across it millimetres."""

STEPS_M = {"int16-decimetres": (0.1, 0.001), "int16-centimetres": (0.01, 0.001)}
"""Metres per step of int16 positions, along and across the road."""


@dataclass(frozen=True)
class Array:
    """One array of a tensor folder.

    Args:
        name: name of the array, and of its file without the ending.
        dtype: NumPy's name of it; `position` = float32 or int16, as the index's `storage` says.
        shape: a letter for each axis, or a number: N rows (entries on the clock), R runs, S samples, K (sample,
            neighbor) pairs, C scenes, M vehicles in scenes. `S+1` is one more.
        meaning: unit, order and sign included.
        counts: the letter of what its values number: they shift when subsets are joined.
    """

    name: str
    dtype: str
    shape: tuple[str, ...]
    meaning: str
    counts: str = ""

    @property
    def file(self) -> str:
        """Name of the array's file."""
        return f"{self.name}.npy"

    def sizes(self, letters: dict[str, int]) -> tuple[int, ...]:
        """Return the shape in numbers."""
        axes = (axis.partition("+") for axis in self.shape)
        return tuple(letters[name] + int(more or 0) if name.isalpha() else int(name) for name, _, more in axes)

    def stored_as(self, storage: str) -> str:
        """Return NumPy's name of the dtype under one of POSITION_STORAGES."""
        return self.dtype if self.dtype != "position" else storage.partition("-")[0]


ARRAYS = (
    Array("run_first_row", "int64", ("R+1",), "rows of run r are [run_first_row[r], run_first_row[r + 1])", "N"),
    Array(
        "neighbor_offset", "int64", ("S+1",), "pairs of sample s are [neighbor_offset[s], neighbor_offset[s + 1])", "K"
    ),
    Array("scene_offset", "int64", ("C+1",), "vehicles of scene c are [scene_offset[c], scene_offset[c + 1])", "M"),
    Array("speed_mps", "float32", ("N",), "recorded speed along the direction of travel, m/s"),
    Array("run_length_m", "float32", ("R",), "the vehicle's length, m; NaN where the source has none"),
    Array("run_width_m", "float32", ("R",), "its width, m; likewise"),
    Array("run_vehicle_id", "int32", ("R",), "unique within the subset"),
    Array("run_first_tick", "int32", ("R",), "tick of the run's first row; time_s = tick / rate_hz"),
    Array("run_subset", "int32", ("R",), "position in the index's `subsets`"),
    Array("sample_row", "int32", ("S",), "the row of each sample's origin, increasing", "N"),
    Array("neighbor_row", "int32", ("K",), "the neighbor's row at the sample's tick", "N"),
    Array("scene_row", "int32", ("M",), "the vehicle's row at the scene's tick, increasing within a scene", "N"),
    Array(
        "scene_sample", "int32", ("M",), "the number of the sample that the vehicle is there; -1 where it is none", "S"
    ),
    Array(
        "position_m",
        "position",
        ("N", "2"),
        "front centre: along the direction of travel, and from the carriageway's left edge, positive to the right; m "
        "(int16: steps of STEPS_M from the subset's `centre_m`)",
    ),
    Array("lane", "int16", ("N",), "1 is the driver's leftmost; 0 where the source has none"),
    Array(
        "finding",
        "uint8",
        ("N",),
        "worst severity of the vehicle's own findings in the frames after the tick before up to this one: 1 + position "
        "in schemas.columns.SEVERITIES; 0 where there is none",
    ),
    Array("sample_part", "uint8", ("S",), "position in schemas.columns.PARTS"),
    Array("sample_lateral", "uint8", ("S",), "position in schemas.columns.LATERAL_MANEUVERS"),
    Array("sample_longitudinal", "uint8", ("S",), "position in schemas.columns.LONGITUDINAL_MANEUVERS"),
    Array("sample_future", "uint8", ("S",), "ticks of the future that are known, 1 to F"),
    Array("neighbor_cell", "int8", ("K",), "13 * column + row of the 13 x 3 grid, increasing within a sample"),
    Array(
        "neighbor_known", "uint8", ("K",), "ticks of the neighbor's history that are known, its last included: 1 to H"
    ),
    Array("scene_part", "uint8", ("C",), "position in schemas.columns.PARTS"),
)

ORDER = """\
A run is a gap-free stretch of one vehicle's ticks inside one block of the split; rows are sorted by (subset,
vehicle_id, tick), runs are stored in that order, one after the other. Pairs are sorted by (sample, cell). A scene is
every vehicle of one (subset, block, tick) at which one of them at least is a sample; scenes are sorted by those three.
"""

MOST_TICKS = 255
"""Greatest H and F, in ticks: known ticks are stored in a byte."""

INDEX_KEYS = {
    "version": "a whole number",
    "split": "text",
    "protocol": "an object",
    "storage": "text",
    "max_error_m": "two numbers",
    "rms_error_m": "two numbers",
    "subsets": "objects",
    "blocks": "objects",
    "sizes": "counts by name",
    "samples_by_part": "counts by name",
    "split_recipe": "an object or null",
}
"""Keys of the index and the kinds of their values."""

INDEX_MEANING = """\
What `index.json` holds: the version; the split's name; the protocol's parameters and digest; how positions are stored;
the greatest and the root-mean-square rounding error of positions in m, along and across the road, as measured on
writing; the subsets in their order, each with the keys below; the split's rows; the sizes by letter; the number of
samples in each part; and of the split's recipe the digest, the parameters and `left_out_vehicles`, how many are left
out of val and eval (null where the recipe is not known)."""

SUBSET_KEYS = {
    "dataset": "text",
    "subset": "text",
    "origin": "text",
    "frame_rate_hz": "a number",
    "centre_m": "two numbers",
    "lane_markings_m": "numbers or null",
    "last_lane": "a whole number",
    "width_m": "a number",
    "lateral_positions": "text",
}
"""Each key of a subset and the kind of its value."""

SUBSET_MEANING = """\
Of each subset: origin, recorded or synthetic; centre_m (2,), the origin of int16 positions, (0, 0) for float32;
lane_markings_m, y of each marking, null where unknown; last_lane, the rightmost lane (by the markings, else the
highest that any entry has: knowledge of the map taken from the whole recording, later moments included); width_m of
the carriageway (the last marking, else 12 ft a lane); lateral_positions, recorded or lane centres: where these stand in
place of lateral positions, errors across the road mean nothing, and scores have none."""

RECORDED_POSITIONS, LANE_CENTRES = "recorded", "lane centres"
"""Values of lateral_positions."""

NOMINAL_LANE_M = 3.6576
"""Width of a lane without known markings, in metres (12 ft), for mirrored positions and the lanes of scenes."""
