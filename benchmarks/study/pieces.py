"""What the study runs, as data: real traffic first."""

from dataclasses import replace

from study.plan import Arm, Learner, Piece, Source

PLAIN = ("constant-velocity", "damped-velocity", "kalman-cv")
PLAIN_PAIRS = (("damped-velocity", "constant-velocity"), ("kalman-cv", "constant-velocity"))
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


def generate(traffic: str, seed: int, title: str, *more: str) -> Source:
    """Declare generated traffic: three minutes of eight free and congested carriageways and one of NGSIM's kind."""
    options = (
        "--traffic",
        traffic,
        "--format",
        "highd",
        "--format",
        "ngsim-text",
        "--minutes",
        "3",
        "--seed",
        f"{seed}",
    )
    return Source(title, sample=(*options, *more))


IDM = generate(
    "varied-idm", 0, "Generated traffic: 200 drivers a carriageway, who follow IDM ([sample.md](sample.md))."
)
KRAUSS = generate("varied-krauss", 1, "Generated traffic: 200 drivers a carriageway follow Krauss's model.")
PARTS = {**BLOCKS, "TRACKLAKE_SPLIT_BLOCK_S": "50", "TRACKLAKE_VALIDATION_PART": "true"}
"""Settings of generated traffic: blocks of 50 s with 8 s between them, some of them for validation."""

V_LSTM, LSTM = Learner("v-lstm", 8, 25_000), Learner("lstm", 8, 25_000)
STACKED, DECODER = Learner("stacked-lstm", 5, 20_000), Learner("lstm-encoder-decoder", 5, 5_000)
CS_LSTM, CS_LSTM_M = Learner("cs-lstm", 5, 20_000), Learner("cs-lstm-m", 5, 20_000)
ATTENTION = Learner("attention-h4", 5, 10_000)
GENERATED = Arm(
    "generated",
    IDM,
    PLAIN,
    (LSTM, V_LSTM, STACKED, ATTENTION, CS_LSTM, CS_LSTM_M, DECODER),
    settings=PARTS,
    pairs=(
        *PLAIN_PAIRS,
        ("cs-lstm", "v-lstm"),
        ("cs-lstm-m", "cs-lstm"),
        ("attention-h4", "cs-lstm"),
        ("attention-h4", "lstm-encoder-decoder"),
    ),
)


def publish(own: Learner) -> Learner:
    """Train as published, until the validation loss stops improving."""
    options = ("--set", "as_published=true", "--patience", "3")
    return replace(own, seeds=5, samples=own.samples // 2, epochs=24, options=options, label=f"{own.model}-published")


def ablate(own: Learner, label: str, *settings: str) -> Learner:
    """Change settings of a model."""
    options = tuple(part for setting in settings for part in ("--set", setting))
    return replace(own, seeds=5, options=options, label=f"{own.model}, {label}")


def pair_with(own: Learner, others: tuple[Learner, ...]) -> tuple[tuple[str, str], ...]:
    """Pair each of the others with a model."""
    return tuple((other.name, own.name) for other in others)


def pair_by_model(firsts: tuple[Learner, ...], others: tuple[Learner, ...]) -> tuple[tuple[str, str], ...]:
    """Pair each of the others with the one of the same model."""
    return tuple(
        pair for own in firsts for pair in pair_with(own, tuple(o for o in others if o.model == own.model and o != own))
    )


OURS = (V_LSTM, STACKED, ATTENTION, CS_LSTM, CS_LSTM_M, DECODER)
PUBLISHED = tuple(map(publish, OURS))
EGO_ONLY = ablate(ATTENTION, "ego-only loss", "ego_only=true")
SHORT_SIGHTED = ablate(ATTENTION, "27 m", "range_m=27.432")
ABLATED = (
    EGO_ONLY,
    ablate(ATTENTION, "no sizes", "sizes=false"),
    ablate(ATTENTION, "no lanes", "lanes=none"),
    ablate(ATTENTION, "two vehicles", "nearest=2"),
    SHORT_SIGHTED,
)
LONG_GRID = replace(CS_LSTM, label="cs-lstm, cells of 9 m", settings={"TRACKLAKE_GRID_CELL_M": "9.144"}, at_home=True)
AXES = tuple(ablate(V_LSTM, f"anchored {axis}", f"anchoring={axis}") for axis in ("none", "longitudinal", "lateral"))
MIRRORED = ablate(V_LSTM, "mirrored", "augmentation=mirror")
AUGMENTED = ablate(CS_LSTM, "mirrored and shifted", "augmentation=both")
ALONE = {
    dataset: tuple(
        replace(
            own,
            seeds=5,
            options=("--dataset", dataset),
            tested=("--dataset", dataset),
            label=f"{own.model}, {title} alone",
        )
        for own in (V_LSTM, CS_LSTM)
    )
    for dataset, title in (("ngsim", "NGSIM-like"), ("highd", "highD-like"))
}
MOVED = tuple(replace(own, seeds=5, source=KRAUSS, label=f"{own.model}, of Krauss") for own in (LSTM, V_LSTM, CS_LSTM))
CLEAN = generate("varied-idm", 0, "The same traffic without any defect.", "--defect", "late_start", "--dose", "0")
DOSED = ("late_start", "frame_gap", "position_jump", "second_track")
"""Defects that are injected, each alone, and whose price is measured for two networks."""
DOSED_ONCE = ("overlap", "early_end", "frozen_slow_speed")
"""Those whose price is measured for the one that learns fast, and without reconstruction."""
CONTROL = "acceleration_spike"
"""Defect that moves no position: its reconstructed tracks show what reconstruction does without one to repair."""
UNSEEN = ("acceleration_spike", "hard_braking", "wrong_headway", "wrong_leader", "lane_flicker")
"""Defects that move no position and remove no entry, so that networks without neighbors learn the same; tested."""
DOSE = 0.2
"""Share of the vehicles that get a defect."""
REPAIRED = {"TRACKLAKE_RECONSTRUCT": "true", "TRACKLAKE_TRACKS_FROM": "reconstructed"}
CLEANLY = (Learner("v-lstm", 5, 12_500), Learner("lstm", 5, 25_000))
"""Networks that are trained on traffic with and without defects: one with a density, and one that learns fast."""


def damage(own: Learner, defect: str, *, repaired: bool = False) -> Learner:
    """Train on traffic with a defect, or on its reconstructed tracks."""
    return replace(
        own,
        label=f"{own.model}, {defect} {DOSE:.0%}{', reconstructed' if repaired else ''}",
        source=generate("varied-idm", 0, "", "--defect", defect, "--dose", str(DOSE)),
        settings=REPAIRED if repaired else {},
    )


DAMAGED = tuple(
    each
    for own, more in zip(CLEANLY, ((), DOSED_ONCE), strict=True)
    for each in (
        *(damage(own, defect, repaired=repaired) for defect in DOSED for repaired in (False, True)),
        *(damage(own, defect) for defect in more),
        damage(own, CONTROL, repaired=True),
    )
)
RESTORED = tuple(own for own in DAMAGED if own.settings)
CONTROLS = tuple(own for own in RESTORED if CONTROL in own.name)
LEAKING = tuple(replace(own, seeds=5) for own in (LSTM, V_LSTM, ATTENTION, CS_LSTM))
FOREST = Arm("forest", IDM, (), (), protocol="grid-2021", settings={"TRACKLAKE_RECONSTRUCT": "false"})
FOREST_TEXT = (
    "The forest of Choi et al. (2021), by information gain, votes on the maneuver from twelve features, and the "
    "maneuver is the column at every horizon; ours predicts the lane at each horizon from 21 features "
    "([training.md](training.md#lane-change-forest)). Both learn from the same 70 % of all vehicles and are scored on "
    "the others, whatever the split of the tensors; another division and another seed were not tried. Drivers change "
    "lanes in a time of their own; labels take 4 s. Rows of cells are those of a model's places. A true place outside "
    "the nine cells is never right; clipped: outer columns and rows have no end; one against rest: the mean over nine "
    "yes-or-no answers, in which a wrong cell costs two ninths."
)

PIECES = (
    Piece(
        "us-101",
        0,
        "Real traffic: US-101",
        "Four blocks of 225 s with 8 s between them; each is predicted by models that were trained on the other three. "
        "Vehicles that are on the road in two blocks are not scored where one of them trains.",
        (
            Arm(
                "US-101",
                US_101,
                PLAIN,
                (
                    Learner("lstm", 8, 50_000),
                    Learner("v-lstm", 8, 30_000),
                    Learner("stacked-lstm", 5, 30_000),
                    Learner("lstm-encoder-decoder", 5, 5_000),
                ),
                settings={**BLOCKS, "TRACKLAKE_SPLIT_BLOCK_S": "225"},
                folds=(0, 1, 2, 3),
                pairs=PLAIN_PAIRS,
            ),
        ),
    ),
    Piece(
        "i-80",
        1,
        "Real traffic with neighbors: I-80",
        "Four blocks of 240 s with 8 s between them; the first and the third, two for the sake of time, are each "
        "predicted by models that were trained on the other three.",
        (
            Arm(
                "I-80",
                I_80,
                PLAIN,
                (
                    Learner("v-lstm", 8, 20_000),
                    Learner("attention-h4", 5, 5_000),
                    Learner("cs-lstm", 5, 20_000),
                    Learner("cs-lstm-m", 5, 20_000),
                    Learner("lstm-encoder-decoder", 5, 5_000),
                ),
                settings={**BLOCKS, "TRACKLAKE_SPLIT_BLOCK_S": "240"},
                folds=(0, 2),
                pairs=(
                    *PLAIN_PAIRS,
                    ("cs-lstm", "v-lstm"),
                    ("cs-lstm-m", "cs-lstm"),
                    ("attention-h4", "cs-lstm"),
                    ("attention-h4", "lstm-encoder-decoder"),
                ),
            ),
        ),
    ),
    Piece(
        "generated",
        2,
        "Generated traffic",
        "Blocks of 50 s with 8 s between them; highD-like recordings are free or congested carriageways at 25 Hz, "
        "NGSIM-like ones at 10 Hz.",
        (GENERATED,),
    ),
    Piece(
        "ablations",
        3,
        "Ablations: attention, social pooling, anchoring, augmentation",
        "The same recordings. One setting of a model is changed: attention learns from the predicted vehicle alone "
        "as the others do, is not given sizes or lanes, is trained with two vehicles around, or sees no farther than "
        "the grid does; the grid's cells are twice as long; V-LSTM counts one axis or both from where they stand, "
        "not from constant velocity; V-LSTM learns from mirrored samples, CS-LSTM from mirrored and shifted ones. "
        "Attention learns from every vehicle that it looks at: with the ego-only loss, two vehicles or 27 m it has "
        "fewer positions to learn from, too, which stand in the table. The one that is trained with two is scored "
        "with ten.",
        (
            replace(
                GENERATED,
                name="ablations",
                learners=(
                    ATTENTION,
                    *ABLATED,
                    CS_LSTM,
                    LONG_GRID,
                    replace(V_LSTM, seeds=5),
                    *AXES,
                    MIRRORED,
                    AUGMENTED,
                ),
                pairs=(
                    *pair_with(ATTENTION, ABLATED),
                    *pair_with(CS_LSTM, (LONG_GRID, AUGMENTED, ATTENTION, EGO_ONLY, SHORT_SIGHTED)),
                    (ATTENTION.name, LONG_GRID.name),
                    *pair_with(V_LSTM, (*AXES, MIRRORED)),
                ),
            ),
        ),
    ),
    Piece(
        "published",
        3,
        "Networks as published",
        "The same recordings. Each network has the inputs, the outputs and the loss of its publication as far as "
        "these samples have them ([models.md](models.md) lists what differs even then) and is trained until three "
        "epochs of its last phase bring no smaller loss on the validation part, or for 24 epochs; the weights with "
        "the smallest loss are kept. Ours are trained for 8 epochs of twice as many samples, and the last weights "
        "are kept. Losses by epoch are in [results-curves.csv](results-curves.csv).",
        (
            replace(
                GENERATED,
                name="as published",
                learners=(*OURS, *PUBLISHED),
                pairs=tuple((f"{own.model}-published", own.model) for own in OURS),
            ),
        ),
    ),
    Piece(
        "one-dataset",
        4,
        "One data set at a time",
        "Models that are trained and scored on one kind of recordings alone, against models that are trained on both "
        "and are scored on that kind here, too. Both are given as many epochs of at most as many samples, so that the "
        "former see each more often; how many they saw stands in the table.",
        tuple(
            replace(
                GENERATED,
                name=f"{dataset} alone",
                learners=(V_LSTM, CS_LSTM, *own),
                pairs=(*PLAIN_PAIRS, *pairs),
                dataset=dataset,
            )
            for dataset, own, pairs in (
                (dataset, own, tuple((one.name, one.model) for one in own)) for dataset, own in ALONE.items()
            )
        ),
    ),
    Piece(
        "transfer",
        4,
        "Trained on one simulator, scored on another",
        "Models that are trained on drivers who follow Krauss's model and scored on drivers who follow IDM, against "
        "models that are trained on the latter. These have learned on other blocks of the recordings that are "
        "scored, the former on recordings of their own: a difference is that of simulators and of familiar "
        "recordings together.",
        (
            replace(
                GENERATED,
                name="transfer",
                learners=(LSTM, V_LSTM, CS_LSTM, *MOVED),
                pairs=tuple((own.name, own.model) for own in MOVED),
            ),
        ),
    ),
    Piece(
        "leakage",
        5,
        "The price of leakage",
        "The split of convolutional social pooling's code (`csp-2018`) cuts every recording by the vehicles' numbers: "
        "vehicles that drive side by side are in different parts. Errors under it are compared with those on the same "
        "recordings parted by blocks of time. Other vehicles are scored: differences are not paired. Constant velocity "
        "learns nothing, so its difference is what the other vehicles make. What is left is no pure price of leakage: "
        "vehicles that brake are another share of what is scored, constant velocity errs most there, and where it errs "
        "more there is more to gain; and `csp-2018` trains on more samples. The last columns make the shares equal.",
        (
            replace(
                GENERATED,
                name="csp-2018",
                learners=LEAKING,
                settings={**BLOCKS, "TRACKLAKE_SPLIT": "csp-2018", "TRACKLAKE_SPLITS": '["csp-2018"]'},
                pairs=(),
            ),
        ),
    ),
    Piece(
        "defects",
        6,
        "The price of defects",
        "One defect of a fifth of the vehicles in otherwise clean traffic; networks are trained on it, or on its "
        "reconstructed tracks, and scored on the same traffic without defects. Of the generator's other defects, five "
        f"({', '.join(f'`{each}`' for each in UNSEEN)}) move no position and remove no entry: these networks learn the "
        "same with them as without. NGSIM's formats cannot record `sideways_speed` and `size_change`, which were not "
        "measured; nor was `backward`, as recordings in which a fifth of the vehicles move backward are excluded from "
        "the samples (`max_backward_share`). A wrong speed turns a highD vehicle, and so moves its front. "
        "Reconstruction smooths what a network learns from, and not what it is scored on; defects that one network "
        "alone learned from were not reconstructed. "
        f"So reconstructed tracks are compared with those of `{CONTROL}`, too, which leaves nothing to repair.",
        (
            replace(
                GENERATED,
                name="defects",
                source=CLEAN,
                learners=(*CLEANLY, *DAMAGED),
                pairs=(*pair_by_model(CLEANLY, DAMAGED), *pair_by_model(CONTROLS, RESTORED)),
            ),
        ),
    ),
    Piece(
        "forest",
        3,
        "Lane changes by a forest, as published and ours",
        FOREST_TEXT,
        (replace(FOREST, forest=("--as-published", "--learning-curve")),),
    ),
    Piece(
        "decoder",
        6,
        "Lane changes by a forest, with the decoder as published",
        "The same, with 1,000 examples, and with the decoder that is fed with its own output: it is trained until "
        "three epochs bring no smaller loss on an eighth of the training vehicles, or for 20 epochs.",
        (replace(FOREST, name="decoder", forest=("--as-published", "--examples", "1000", "--epochs", "20")),),
    ),
)
