"""Recordings of the study, real and generated, and the settings of their lakes."""

from study.plan import Source

PLAIN = ("constant-velocity", "damped-velocity", "kalman-cv")
BLOCKS = {
    "TRACKLAKE_SPLIT": "time-blocks",
    "TRACKLAKE_SPLITS": '["time-blocks"]',
    "TRACKLAKE_RECONSTRUCT": "false",
}

US_101 = Source(
    "US-101, 2005-06-15 07:50, an excerpt of NGSIM (U.S. Department of Transportation 2016): 290 of 2,169 vehicles, so "
    "that no vehicle's neighbors are known. It has no lanes; samples were given lanes of 12 ft from `Local_X`.",
    file="ngsim/us101_0750_290_vehicles.csv.gz",
    lane_ft=12.0,
    lacks_vehicles=True,
)
I_80 = Source(
    "I-80, 2005-04-13 16:00, extracted again from NGSIM's video by Coifman and Li (2017), A critical evaluation of the "
    "Next Generation Simulation (NGSIM) vehicle trajectory dataset, Transportation Research Part B 105: 2,283 vehicles "
    "with lanes and neighbors, but without lateral positions and sizes: every vehicle is 4.27 m long and 1.83 m wide. "
    "Only errors along the road mean anything.",
    file="i80_coifman_li_2017/trajectories-i80-1600-1615.csv.gz",
)


FORMATS = ("highd", "ngsim-text")
"""Formats of generated recordings."""


def generate(traffic: str, seed: int, title: str, *more: str, formats: tuple[str, ...] = FORMATS) -> Source:
    """Declare generated traffic: three minutes of eight free and congested carriageways and one of NGSIM's kind."""
    named = [word for name in formats for word in ("--format", name)]
    return Source(title, sample=("--traffic", traffic, *named, "--minutes", "3", "--seed", f"{seed}", *more))


IDM = generate(
    "varied-idm", 0, "Generated traffic: 200 drivers a carriageway, who follow IDM ([sample.md](sample.md))."
)
KRAUSS = generate("varied-krauss", 1, "Generated traffic: 200 drivers a carriageway follow Krauss's model.")
PARTS = {**BLOCKS, "TRACKLAKE_SPLIT_BLOCK_S": "50", "TRACKLAKE_VALIDATION_PART": "true"}
"""Settings of generated traffic: blocks of 50 s with 8 s between them, some of them for validation."""
