"""How near reconstructed tracks come to the truth, beside the literature's ways of smoothing.

    python benchmarks/reconstruction_accuracy.py [--data DIR] [--minutes 1] [--excerpts DIR] [--write]

Samples of the same traffic are generated under each noise model and ingested, once to tune on (seed 1) and once to
judge on (seed 2). Every method's parameters are those with the least geometric mean of the errors (RMSE) of speed and
acceleration on the first sample; its errors on the second are printed, with 95 % intervals over vehicles. `--excerpts`
names a folder of recorded excerpts of NGSIM, of which share of accelerations beyond 3 m/s2 and changes of the jerk's
sign are printed before and after. `--write` puts the tables into docs/reconstruction.md, and makes its figure.
"""

import argparse
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from reconstruction_data import Recording, apply_reconstruction, read_recordings, write_samples
from reconstruction_excerpts import render_excerpts
from reconstruction_figure import draw_vehicle
from reconstruction_methods import (
    Motion,
    average_exponentially,
    average_moving,
    differentiate,
    fit_savitzky_golay,
    smooth_kalman,
)
from reconstruction_page import Comparison, render_comparisons, replace_tables
from reconstruction_scores import Tally, add_tallies, draw_weights, score_motion

from tracklake.pipeline.synthetic import NOISE_MODELS
from tracklake.pipeline.transforms.reconstruction.config import ReconstructionConfig

TUNING_SEED, JUDGED_SEED = 1, 2
MODELS = {**{name: (name,) for name in NOISE_MODELS}, "all together": NOISE_MODELS}
"""Noise models by the name that is printed."""
RATES = {10.0: "NGSIM's 10 Hz", 25.0: "highD's 25 Hz"}
PAGE = Path(__file__).parents[1] / "docs/reconstruction.md"
SECONDS = (0.2, 0.4, 0.6, 0.8, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0)
"""Windows that are tried, in s."""
WIDTHS_S = (0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8)
"""Widths of exponential weights that are tried, in s."""
JERK_DENSITIES = tuple(10.0**power for power in np.arange(-3, 7.1, 0.5))
"""Densities of jerk that are tried, per variance of the positions' noise."""
WEIGHTS_S6 = tuple(10.0**power for power in np.arange(-3, 1.1))
"""Weights of the squared third derivative that are tried, in s6."""

Apply = Callable[[Recording], Motion]


@dataclass(frozen=True)
class Method:
    """A method with its tuned parameters, as printed, and what it does to a recording."""

    name: str
    parameters: str
    apply: Apply


def measure(apply: Apply, recordings: Iterable[Recording]) -> Tally:
    """Compare a method's motion with the truth, over the vehicles of all recordings."""
    return add_tallies([score_motion(apply(each), each.scene) for each in recordings])


def tune(
    recordings: Sequence[Recording], candidates: Iterable[float], make: Callable[[float], Apply], *names: str
) -> float:
    """Return the candidate with the least geometric mean of some errors."""

    def rate(value: float) -> float:
        found = measure(make(value), recordings).rate()
        return float(np.prod([found[name][0] for name in names]))

    return min(candidates, key=rate)


def tune_methods(recordings: Sequence[Recording]) -> list[Method]:
    """Tune every method on recordings with the truth."""
    both = ("speed", "accel")

    def plain(smooth: Callable[..., Motion]) -> Callable[[float], Apply]:
        return lambda value: lambda each: smooth(each.scene.x, each.scene.runs, value)

    def spread(part: str) -> Callable[[float], Apply]:
        return lambda value: lambda each: smooth_exponentially(each, **{part: value})

    def ours(value: float) -> Apply:
        return lambda each: apply_reconstruction(each, ReconstructionConfig(weight_x_s6=value))

    window = tune(recordings, SECONDS, plain(average_moving), *both)
    polynomial = tune(recordings, SECONDS, plain(fit_savitzky_golay), *both)
    density = tune(recordings, JERK_DENSITIES, plain(smooth_kalman), *both)
    widths = {
        part: tune(recordings, WIDTHS_S, spread(part), name)
        for part, name in (("x_s", "position"), ("speed_s", "speed"), ("accel_s", "accel"))
    }
    weight = tune(recordings, WEIGHTS_S6, ours, *both)
    return [
        Method("recorded values", "", lambda each: each.scene.recorded),
        Method("recorded positions, differentiated", "", differentiate_positions),
        Method("moving average", f"{window:g} s", plain(average_moving)(window)),
        Method("Savitzky-Golay, cubic", f"{polynomial:g} s", plain(fit_savitzky_golay)(polynomial)),
        Method(
            "symmetric exponential",
            " / ".join(f"{value:g}" for value in widths.values()) + " s",
            lambda each: smooth_exponentially(each, **widths),
        ),
        Method("Kalman RTS, white jerk", f"{density:.3g} /s5", plain(smooth_kalman)(density)),
        Method("tracklake, tuned", f"{weight:.2g} s6", ours(weight)),
        Method("tracklake", "", lambda each: apply_reconstruction(each, ReconstructionConfig())),
    ]


def differentiate_positions(recording: Recording) -> Motion:
    """Differentiate recorded positions twice."""
    speed = differentiate(recording.scene.x, recording.scene.runs)
    return Motion(recording.scene.x, speed, differentiate(speed, recording.scene.runs))


def smooth_exponentially(recording: Recording, x_s: float = 0.5, speed_s: float = 1.0, accel_s: float = 4.0) -> Motion:
    """Differentiate first, then average positions, speeds and accelerations, each with a width of its own."""
    runs, raw = recording.scene.runs, differentiate_positions(recording)
    pairs = zip((raw.x, raw.speed, raw.accel), (x_s, speed_s, accel_s), strict=True)
    return Motion(*(average_exponentially(values, runs, width) for values, width in pairs))


def compare(folder: Path, name: str, rate_hz: float) -> Comparison:
    """Compare all methods under one noise model at one frame rate."""
    methods = tune_methods(read_recordings(folder, name, TUNING_SEED, rate_hz))
    judged = read_recordings(folder, name, JUDGED_SEED, rate_hz)
    methods.append(Method("truth", "", lambda each: each.scene.true))
    tallies = [measure(method.apply, judged) for method in methods]
    weights = draw_weights(len(tallies[0].sums["speed"]))
    return Comparison(
        noise=name,
        rate=RATES[rate_hz],
        vehicles=weights.shape[1],
        entries=int(tallies[0].counts["speed"].sum()),
        parameters={method.name: method.parameters for method in methods},
        values={method.name: tally.rate() for method, tally in zip(methods, tallies, strict=True)},
        draws={method.name: tally.rate(weights) for method, tally in zip(methods, tallies, strict=True)},
    )


def main() -> None:
    """Generate what is missing, tune, judge, and print or write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of the samples, which are kept and used again")
    parser.add_argument("--minutes", type=float, default=1.0, help="length of the recordings")
    parser.add_argument("--noise", choices=list(MODELS), action="append", help="only this noise model; repeatable")
    parser.add_argument("--excerpts", type=Path, help="folder of recorded excerpts")
    parser.add_argument("--write", action="store_true", help="write docs/reconstruction.md")
    options = parser.parse_args()
    names = options.noise or list(MODELS)
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.data or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for seed in (TUNING_SEED, JUDGED_SEED):
            write_samples(folder, {name: MODELS[name] for name in names}, options.minutes, seed)
        comparisons = []
        for rate_hz in RATES:
            for name in names:
                comparisons.append(compare(folder, name, rate_hz))
                print(render_comparisons(comparisons[-1:]), flush=True)
        excerpts = render_excerpts(options.excerpts) if options.excerpts else None
        print(excerpts or "no excerpts")
        if options.write:
            replace_tables(PAGE, "comparison", render_comparisons(comparisons))
            if excerpts:
                replace_tables(PAGE, "excerpts", excerpts)
            judged = read_recordings(folder, names[-1], JUDGED_SEED, min(RATES))
            PAGE.with_suffix(".svg").write_bytes(draw_vehicle(judged).render(".svg"))


if __name__ == "__main__":
    main()
