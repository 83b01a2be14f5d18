"""Quadratic programs of many pieces at once, by one interior-point method on banded matrices.

Each piece has its own program: the smallest d'Hd / 2 with A d <= b. H is that of the smoother, and d the way from the
smoothed positions, where the gradient is zero. A row of A combines at most four neighbouring points; so the matrix of
Newton's step, H + A' diag A, has the same four diagonals as H, and one banded factorisation serves all pieces. Each
piece has its own step length and barrier. The method is Mehrotra's predictor and corrector for quadratic programs
(Nocedal and Wright 2006, Numerical Optimization, algorithm 16.4). Rows with a price may be broken: they are an exact
l1 penalty (section 17.2 there).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from tracklake.pipeline.transforms.reconstruction.smoothing import multiply_bands
from tracklake.schemas.arrays import Flags, Floats, Integers

MAX_STEPS = 80
"""Newton steps after which a piece is given up; 15 to 25 are usual."""
ROWS_RESIDUAL = 1e-7
"""Largest residual of a row, in its unit, at which a program is solved."""
FORCE_RESIDUAL_M = 1e-5
"""Largest residual of the gradient, in m, at which a program is solved."""
GAP_M2 = 1e-9
"""Largest mean complementarity, in m2, at which a program is solved."""
ROUNDED_GAP_M2 = 1e-7
"""Largest mean complementarity, in m2, at which a program is solved if rounding makes its gradient grow again. The
penalty is 250 times as large at 25 Hz as at 10 Hz, so FORCE_RESIDUAL_M is out of reach there."""
TO_THE_BOUND = 0.995
"""Share of the way to the nearest bound that a step may take."""
LEAST_STEP = 1e-10
"""Step length below which a piece does not move any more."""
TINY = 1e-300
"""Least number that is divided by."""
DAMPING = 1e-14
"""Share by which the diagonal of Newton's matrix is raised, so that rounding leaves it positive definite."""
FIRST_GAP_M2 = 1e-3
"""Complementarity at which the method starts, in m2."""


@dataclass
class Rows:
    """Rows of one form: sum of coefficients[k] * d[i + k] <= bound.

    Args:
        coefficients: at most four.
        bound: (R,) right-hand sides.
        valid: (R,) which of the rows exist; the others would reach into the next piece.
        scale: typical size of the sum, for the starting point.
        at: (P,) point i of the row of each piece; None = the rows start at the points 0 to R - 1.
        price: cost of breaking a row, per its unit; None = all are kept.
    """

    coefficients: tuple[float, ...]
    bound: Floats
    valid: Flags
    scale: float
    at: Integers | None = None
    price: float | None = None
    slack: Floats = field(init=False)
    force: Floats = field(init=False)
    excess: Floats = field(init=False)
    spare: Floats = field(init=False)

    def start(self) -> None:
        """Set the slack of each row, its force, and (with a price) its excess and the force's distance to the price."""
        self.bound = np.where(self.valid, self.bound, 1.0)
        self.slack = np.where(self.valid, np.maximum(self.bound, 0.1 * self.scale), 1.0)
        self.force = np.where(self.valid, FIRST_GAP_M2 / self.slack, 0.0)
        if self.price is not None:
            self.force = np.minimum(self.force, 0.5 * self.price)
            self.spare = self.price - self.force
            self.excess = np.where(self.valid, FIRST_GAP_M2 / self.spare, 0.0)

    def apply(self, d: Floats) -> Floats:
        """Return the rows' sums (R,)."""
        count = len(self.bound)
        total: Floats = np.zeros(count)
        for k, coefficient in enumerate(self.coefficients):
            total += coefficient * (d[k : k + count] if self.at is None else d[self.at + k])
        return total

    def add_transposed(self, out: Floats, values: Floats) -> None:
        """Add the transposed rows times values (R,) to `out` (N,)."""
        for k, coefficient in enumerate(self.coefficients):
            out[self._get_points(k)] += coefficient * values

    def add_squares(self, bands: Floats, weights: Floats) -> None:
        """Add the transposed rows * weights (R,) * rows to the lower diagonals (4, N)."""
        for a, left in enumerate(self.coefficients):
            points = self._get_points(a)
            for b, right in enumerate(self.coefficients[a:]):
                bands[b][points] += (left * right) * weights

    def _get_points(self, k: int) -> slice | Integers:
        return slice(k, k + len(self.bound)) if self.at is None else self.at + k

    def reduce(self, ufunc: np.ufunc, values: Floats, first: Integers, points: int, empty: float) -> Floats:
        """Reduce values of the rows (R,) to one per piece (P,)."""
        if self.at is not None:
            return values
        padded = np.full(points, empty)
        padded[: len(values)] = np.where(self.valid, values, empty)
        reduced: Floats = ufunc.reduceat(padded, first)
        return reduced


@dataclass
class _Direction:
    """Step of one set of rows, (R,) each."""

    slack: Floats
    force: Floats
    excess: Floats | None


def solve_programs(bands: Floats, rows: Sequence[Rows], first: Integers, size: Integers) -> tuple[Floats, Flags]:
    """Solve the programs of P pieces with N points; return d (N,) and which pieces are solved (P,).

    Args:
        bands: (4, N) lower diagonals of H.
        rows: rows of A; d = 0 need not keep them.
        first: (P,) first point of each piece.
        size: (P,) points of each piece.
    """
    from scipy.linalg import LinAlgError

    programs = _Programs(bands, rows, first, size)
    for _ in range(MAX_STEPS):
        programs.measure_residuals()
        if programs.solved.all():
            break
        try:
            if not programs.step():
                break
        except LinAlgError:
            break
    return programs.d, programs.solved


class _Programs:
    """State of the programs of all pieces; the arguments are those of `solve_programs`."""

    def __init__(self, bands: Floats, rows: Sequence[Rows], first: Integers, size: Integers) -> None:
        self.bands, self.rows, self.first, self.size = bands, rows, first, size
        self.d = np.zeros(bands.shape[1])
        self.solved = np.zeros(len(first), bool)
        self.gradient, self.gap, self.force_m = self.d, np.zeros(len(first)), np.full(len(first), np.inf)
        self.residuals: list[Floats] = []
        for one in rows:
            one.start()
        self.count = np.maximum(self.add_up([np.where(one.valid, 2.0 if one.price else 1.0, 0.0) for one in rows]), 1)

    def add_up(self, values: Sequence[Floats]) -> Floats:
        """Add values of all rows, (R,) each, up to one per piece (P,)."""
        total = np.zeros(len(self.first))
        for one, own in zip(self.rows, values, strict=True):
            total += one.reduce(np.add, own, self.first, len(self.d), 0.0)
        return total

    def measure_residuals(self) -> None:
        """Measure the gradient of the Lagrange function, the rows' residuals and the complementarity."""
        self.gradient = multiply_bands(self.bands, self.d)
        self.residuals = []
        products = []
        for one in self.rows:
            one.add_transposed(self.gradient, one.force)
            residual = one.apply(self.d) + one.slack - one.bound
            product = one.slack * one.force
            if one.price is not None:
                residual -= one.excess
                product = product + one.excess * one.spare
            self.residuals.append(np.where(one.valid, residual, 0.0))
            products.append(product)
        self.gap = self.add_up(products) / self.count
        force_m = np.maximum.reduceat(np.abs(self.gradient), self.first)
        worst = np.zeros(len(self.first))
        for one, residual in zip(self.rows, self.residuals, strict=True):
            reduced = one.reduce(np.maximum, np.abs(residual), self.first, len(self.d), 0.0)
            worst = np.maximum(worst, reduced / (ROWS_RESIDUAL * one.scale))
        exact = (force_m <= FORCE_RESIDUAL_M) & (self.gap <= GAP_M2)
        rounded = (force_m > self.force_m) & (self.gap <= ROUNDED_GAP_M2)
        self.solved |= (worst <= 1) & (exact | rounded)
        self.force_m = force_m

    def step(self) -> bool:
        """Take one step of predictor and corrector; return whether any piece moved."""
        newton = _Newton(self)
        plain = [(one.slack * one.force, None if one.price is None else one.excess * one.spare) for one in self.rows]
        _, guess = newton.find_direction(plain)
        length = self.find_lengths(guess, 1.0)
        ahead = []
        for one, way in zip(self.rows, guess, strict=True):
            own = self.repeat_by_piece(one, length)
            product = (one.slack + own * way.slack) * (one.force + own * way.force)
            if way.excess is not None:
                product += (one.excess + own * way.excess) * (one.spare - own * way.force)
            ahead.append(product)
        aim = self.gap * np.clip(self.add_up(ahead) / self.count / np.maximum(self.gap, TINY), 0, 1) ** 3
        targets: list[tuple[Floats, Floats | None]] = []
        for one, way, (product, priced) in zip(self.rows, guess, plain, strict=True):
            own = self.repeat_by_piece(one, aim)
            second = None if priced is None or way.excess is None else priced - way.excess * way.force - own
            targets.append((np.where(one.valid, product + way.slack * way.force - own, 0.0), second))
        d, ways = newton.find_direction(targets)
        length = np.where(self.solved, 0.0, self.find_lengths(ways, TO_THE_BOUND))
        for one, way in zip(self.rows, ways, strict=True):
            own = self.repeat_by_piece(one, length)
            one.slack += own * way.slack
            one.force += own * way.force
            if way.excess is not None:
                one.excess += own * way.excess
                one.spare -= own * way.force
        self.d += np.repeat(length, self.size) * d
        return bool((length > LEAST_STEP).any())

    def repeat_by_piece(self, one: Rows, values: Floats) -> Floats:
        """Return values per piece (P,) at the rows of one form (R,)."""
        return values if one.at is not None else np.repeat(values, self.size)[: len(one.bound)]

    def find_lengths(self, ways: Sequence[_Direction], share: float) -> Floats:
        """Return the longest step of each piece (P,), at most 1, that goes a share of the way to the nearest bound."""
        length = np.ones(len(self.first))
        for one, way in zip(self.rows, ways, strict=True):
            pairs = [(one.slack, way.slack), (one.force, way.force)]
            if way.excess is not None:
                pairs += [(one.excess, way.excess), (one.spare, -way.force)]
            for value, change in pairs:
                fraction = np.divide(-value, change, out=np.full(len(value), 2.0), where=change < 0)
                reduced = one.reduce(np.minimum, fraction, self.first, len(self.d), 2.0)
                length = np.minimum(length, share * reduced)
        return length


class _Newton:
    """Newton's equations at one state: one factorisation, solved twice."""

    def __init__(self, programs: _Programs) -> None:
        from scipy.linalg import cholesky_banded

        self.programs = programs
        matrix = programs.bands.copy()
        self.weights: list[Floats] = []
        for one in programs.rows:
            compliance = one.slack / np.maximum(one.force, TINY)
            if one.price is not None:
                compliance = compliance + one.excess / one.spare
            self.weights.append(np.where(one.valid, 1 / compliance, 0.0))
            one.add_squares(matrix, self.weights[-1])
        matrix[0] *= 1 + DAMPING
        self.factor = cholesky_banded(matrix, overwrite_ab=True, lower=True, check_finite=False)

    def find_direction(self, targets: list[tuple[Floats, Floats | None]]) -> tuple[Floats, list[_Direction]]:
        """Solve for a step of d (N,) and of all rows.

        Args:
            targets: slack * force, and excess * spare of priced rows, minus what they should become.
        """
        from scipy.linalg import cho_solve_banded

        programs = self.programs
        right = -programs.gradient
        parts = []
        for one, weight, residual, (product, priced) in zip(
            programs.rows, self.weights, programs.residuals, targets, strict=True
        ):
            part = residual - product / np.maximum(one.force, TINY)
            if priced is not None:
                part = part + priced / one.spare
            parts.append(part)
            one.add_transposed(right, -weight * part)
        way = cho_solve_banded((self.factor, True), right, check_finite=False)
        directions = []
        for one, weight, part, (product, priced) in zip(programs.rows, self.weights, parts, targets, strict=True):
            force = weight * (one.apply(way) + part)
            slack = np.where(one.valid, (-product - one.slack * force) / np.maximum(one.force, TINY), 0.0)
            excess = None if priced is None else np.where(one.valid, (one.excess * force - priced) / one.spare, 0.0)
            directions.append(_Direction(slack, force, excess))
        return way, directions
