"""NGSIM's trajectory files as shipped: the portal's names, feet, and one row per (vehicle, frame).

Units and meanings are those of the U.S. DOT's data dictionary (doi.org/10.21949/1504477). The 18 fields of the original
text files come first, in their order; the 25-column export adds the others. Bounds are what a readable line cannot
exceed; a line beyond them is rejected.
"""

import polars as pl

from tracklake.schemas.columns import Table, column

RAW_NGSIM = Table(
    "raw_ngsim",
    "One row per line of an NGSIM trajectory file.",
    key=("line",),
    partition=(),
    columns={
        "line": column(pl.Int64, "number of the line in its file, from 1", ge=1),
        "Vehicle_ID": column(pl.Int32, "ascending by time of entry; restarts in every recording", ge=0),
        "Frame_ID": column(pl.Int32, "tenths of a second", ge=0),
        "Total_Frames": column(pl.Int32, "frames in which the vehicle appears", ge=0, nullable=True),
        "Global_Time": column(pl.Int64, "ms since 1970 (Peachtree: another clock)", unit="ms", ge=0),
        "Local_X": column(pl.Float64, "lateral, from the section's left edge", unit="ft", ge=-1_500, le=1_500),
        "Local_Y": column(pl.Float64, "longitudinal, front centre", unit="ft", ge=-1_000, le=50_000),
        "v_length": column(pl.Float64, "of the vehicle", unit="ft", ge=0, le=300, nullable=True),
        "v_Width": column(pl.Float64, "of the vehicle", unit="ft", ge=0, le=60, nullable=True),
        "v_Class": column(pl.Int16, "1 motorcycle, 2 car, 3 truck; 0 = unknown", ge=0, le=3, nullable=True),
        "v_Vel": column(pl.Float64, "instantaneous speed", unit="ft/s", ge=-130, le=320),
        "v_Acc": column(pl.Float64, "instantaneous acceleration", unit="ft/s2", ge=-650, le=650, nullable=True),
        "Lane_ID": column(pl.Int16, "1 is the leftmost", ge=0, le=200, nullable=True),
        "Direction": column(pl.Float64, "1 east, 2 north, 3 west, 4 south; arterials only", ge=0, le=4, nullable=True),
        "Preceding": column(pl.Int32, "id of the vehicle ahead in the lane, 0 = none", ge=0, nullable=True),
        "Following": column(pl.Int32, "id of the vehicle behind in the lane, 0 = none", ge=0, nullable=True),
        "Space_Headway": column(
            pl.Float64, "front to front to the vehicle ahead", unit="ft", ge=-50_000, le=50_000, nullable=True
        ),
        "Time_Headway": column(pl.Float64, "to the vehicle ahead; 9999.99 = standing", unit="s", nullable=True),
        "Location": column(pl.String, "i-80, us-101, lankershim or peachtree", nullable=True),
    },
)
