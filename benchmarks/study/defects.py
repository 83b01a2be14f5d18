"""The price of defects, as a piece of the study: each defect alone, in shares of the vehicles of clean traffic."""

from collections.abc import Mapping
from dataclasses import replace

from study.plan import Arm, Learner, Piece, Source
from study.traffic import FORMATS, PARTS, PLAIN, generate

V_LSTM, LSTM = Learner("v-lstm", 5, 12_500), Learner("lstm", 5, 25_000)
"""Networks that are trained on traffic with and without defects: one with a density, and one that learns fast."""
DOSE, HIGH_DOSE = 0.2, 0.5
"""Shares of the vehicles that get a defect, as far as so many can have it."""
REPAIRED = ("late_start", "frame_gap", "position_jump", "second_track")
"""Defects whose price is measured for both networks, and on reconstructed tracks, too."""
AT_TWO_DOSES = (*REPAIRED, "early_end", "overlap")
"""Defects whose price is measured at both doses, for the network that learns fast."""
HIGHD_ONLY = ("sideways_speed", "size_change")
"""Defects that NGSIM's formats cannot record."""
CONTROL = "acceleration_spike"
"""Defect that moves no position: its reconstructed tracks show what reconstruction does without one to repair."""
UNSEEN = ("acceleration_spike", "hard_braking", "wrong_headway", "wrong_leader", "lane_flicker")
"""Defects that move no position and remove no entry, so that networks without neighbors learn the same; tested."""
RECONSTRUCTED = {"TRACKLAKE_RECONSTRUCT": "true", "TRACKLAKE_TRACKS_FROM": "reconstructed"}
TRACKS = ", reconstructed"
"""End of the name of a network that learns from reconstructed tracks."""
BACKWARD = {"TRACKLAKE_MAX_BACKWARD_SHARE": "1"}
"""Settings under which recordings with vehicles that move backward are kept."""


def inject(defect: str, dose: float, formats: tuple[str, ...], title: str = "") -> Source:
    """Declare generated traffic in which a share of the vehicles has a defect."""
    return generate("varied-idm", 0, title, "--defect", defect, "--dose", str(dose), formats=formats)


def damage(
    own: Learner,
    defect: str,
    dose: float = DOSE,
    *,
    formats: tuple[str, ...] = FORMATS,
    settings: Mapping[str, str] | None = None,
) -> Learner:
    """Train on traffic with a defect, or on its reconstructed tracks."""
    label = f"{own.model}, {defect} {dose:.0%}{TRACKS if settings == RECONSTRUCTED else ''}"
    return replace(own, label=label, source=inject(defect, dose, formats), settings=settings or {})


def pair_with_first(first: Learner, *others: Learner) -> tuple[tuple[str, str], ...]:
    """Pair networks with the one that was trained without a defect to learn from."""
    return tuple((own.name, first.name) for own in others)


CLEAN = inject("late_start", 0, FORMATS, "The same traffic without any defect.")
CLEAN_HIGHD = inject("late_start", 0, ("highd",), "The eight carriageways in highD's format, without any defect.")
DAMAGED_V_LSTM = tuple(damage(V_LSTM, defect) for defect in REPAIRED)
DAMAGED_LSTM = (
    *(damage(LSTM, defect, dose) for defect in AT_TWO_DOSES for dose in (DOSE, HIGH_DOSE)),
    damage(LSTM, "frozen_slow_speed"),
    damage(LSTM, "backward", settings=BACKWARD),
)
CONTROLS = tuple(damage(own, CONTROL, settings=RECONSTRUCTED) for own in (V_LSTM, LSTM))
MENDED = tuple(tuple(damage(own, defect, settings=RECONSTRUCTED) for defect in REPAIRED) for own in (V_LSTM, LSTM))
LSTM_HIGHD = replace(LSTM, samples=15_000)
DAMAGED_HIGHD = tuple(
    damage(LSTM_HIGHD, defect, dose, formats=("highd",)) for defect in HIGHD_ONLY for dose in (DOSE, HIGH_DOSE)
)

DEFECTS = Piece(
    "defects",
    6,
    "The price of defects",
    "One defect of a share of the vehicles in otherwise clean traffic; networks are trained on it and scored on the "
    "same traffic without defects. The generator has fifteen. Five "
    f"({', '.join(f'`{each}`' for each in UNSEEN)}) move no position and remove no entry: these networks learn the "
    "same with them as without. A wrong speed turns a highD vehicle, and so moves its front. Overlaps need a leader "
    "that is near: fewer vehicles have one than were asked for. Recordings in which vehicles move backward are "
    "otherwise excluded from the samples (`max_backward_share`). Reconstruction smooths positions. A network must be "
    "scored on tracks of the kind that it was trained on: networks of reconstructed tracks are scored on reconstructed "
    f"tracks of the clean traffic, and compared with one of the reconstructed tracks of `{CONTROL}`, which leaves "
    "nothing to repair. Only that one is scored on recorded tracks, too.",
    (
        Arm(
            "defects",
            CLEAN,
            PLAIN,
            (V_LSTM, LSTM, *DAMAGED_V_LSTM, *DAMAGED_LSTM, *CONTROLS),
            settings=PARTS,
            pairs=(
                *pair_with_first(V_LSTM, *DAMAGED_V_LSTM, CONTROLS[0]),
                *pair_with_first(LSTM, *DAMAGED_LSTM, CONTROLS[1]),
            ),
        ),
        Arm(
            "defects, reconstructed",
            replace(CLEAN, title="The same traffic without any defect, reconstructed."),
            PLAIN,
            tuple(
                replace(own, settings={})
                for control, mended in zip(CONTROLS, MENDED, strict=True)
                for own in (control, *mended)
            ),
            settings={**PARTS, **RECONSTRUCTED},
            pairs=tuple(
                pair
                for control, mended in zip(CONTROLS, MENDED, strict=True)
                for pair in pair_with_first(control, *mended)
            ),
        ),
        Arm(
            "defects of highD alone",
            CLEAN_HIGHD,
            PLAIN,
            (LSTM_HIGHD, *DAMAGED_HIGHD),
            settings=PARTS,
            pairs=pair_with_first(LSTM_HIGHD, *DAMAGED_HIGHD),
        ),
    ),
)
