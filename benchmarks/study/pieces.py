"""What the study runs, as data: real traffic first."""

from dataclasses import replace

from study.defects import DEFECTS
from study.plan import EVAL_BLOCK, Arm, Learner, Piece
from study.traffic import BLOCKS, I_80, IDM, KRAUSS, PARTS, PLAIN, US_101

PLAIN_PAIRS = (("damped-velocity", "constant-velocity"), ("kalman-cv", "constant-velocity"))
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
LEAKING = tuple(replace(own, seeds=5) for own in (LSTM, V_LSTM, ATTENTION, CS_LSTM))
CSP_2018 = {"TRACKLAKE_SPLIT": "csp-2018", "TRACKLAKE_SPLITS": '["csp-2018"]'}
BY_BLOCK = {"TRACKLAKE_SPLIT_BLOCK_S": "50"}
LENT = tuple(replace(own, settings={**CSP_2018, **dict.fromkeys((*BY_BLOCK, EVAL_BLOCK), "")}) for own in LEAKING)
FAIR = tuple(replace(own, label=f"{own.model}, time-blocks") for own in LEAKING)
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
        "recordings parted by blocks of time; other vehicles are scored there. The price of leakage is measured on the "
        "same samples: those of vehicles that `csp-2018` evaluates, in a block of time that `time-blocks` leaves out: "
        "the third, or the sixth where there is one, in which most of these vehicles drive. "
        "Networks that were trained under `csp-2018` have seen vehicles around these at the same time, those that were "
        "trained under `time-blocks` nothing of that time. The former so have more samples to draw from, too, and more "
        "that are like those that are scored: a price is of all that, though both were given equally many.",
        (
            Arm("csp-2018", IDM, PLAIN, LEAKING, settings={**BLOCKS, **CSP_2018}),
            Arm(
                "csp-2018, same samples",
                replace(
                    IDM,
                    title="Vehicles that no network was trained on. Those without a suffix are of `csp-2018`.",
                ),
                PLAIN,
                (*LENT, *FAIR),
                settings={**BLOCKS, **BY_BLOCK},
                folds=(2, 5),
                pairs=tuple((own.name, fair.name) for own, fair in zip(LENT, FAIR, strict=True)),
                is_unseen=True,
            ),
        ),
    ),
    DEFECTS,
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
