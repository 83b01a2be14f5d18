"""Formats of an instrumented vehicle's logs, recognised by the first bytes of a file."""

from tracklake.pipeline.sources.csv import BOM
from tracklake.pipeline.sources.v2v.bag_records import ROS1_MAGIC
from tracklake.pipeline.sources.v2v.bags import is_bag
from tracklake.pipeline.sources.v2v.bsmp1 import recognise_bsmp1
from tracklake.pipeline.sources.v2v.pilot_json import recognise_pilot_json
from tracklake.pipeline.sources.v2v.truth import TRUTH_MARK
from tracklake.pipeline.sources.v2v.uper import recognise_hex

BSMP1, PILOT_JSON, HEX, TRUTH = "bsmp1", "pilot-json", "bsm-hex", "drive-truth"
"""Dialects of text files: three of messages, and the truth of a synthetic drive."""
ROS1, ROS2, ROS2_STORAGE = "ros1-bag", "ros2-bag", "ros2-storage"
"""Dialects of bags: a file, the metadata of a bag that is a folder, and the files with its messages."""
ROS2_PARTS = (ROS2, ROS2_STORAGE)
"""Dialects of the files of a bag that is a folder."""
BAGS = (ROS1, *ROS2_PARTS)
"""Dialects of all files of bags."""
RECOGNISED_BY = {BSMP1: recognise_bsmp1, PILOT_JSON: recognise_pilot_json, HEX: recognise_hex}
"""Functions that recognise logs of messages, by dialect."""


def detect(head: bytes, name: str) -> str | None:
    """Return the dialect of a drive's log, or None for a file of another kind."""
    if is_bag(head, name):
        return ROS1 if head.startswith(ROS1_MAGIC) else ROS2_STORAGE
    if head.removeprefix(BOM).startswith(TRUTH_MARK):
        return TRUTH
    if b"rosbag2_bagfile_information" in head[:1000]:
        return ROS2
    return next((dialect for dialect, recognises in RECOGNISED_BY.items() if recognises(head)), None)
