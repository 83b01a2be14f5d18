"""Some seconds of traffic in NGSIM's columns: positions, speeds, lanes, sizes and neighbors fit one another."""

from raw_texts import TEXT_NAMES, US_101_0750, ngsim_row

LANE_FT = 12
FEET_M = 0.3048
FEET_COLUMNS = ("Local_X", "Local_Y", "v_length", "v_Width", "v_Vel", "v_Acc", "Space_Headway")


def make_traffic(vehicles=8, frames=60, key=US_101_0750):
    """Rows by vehicle and frame; vehicle k + 2 follows vehicle k by about 100 ft, in two lanes."""
    rows = []
    for number in range(1, vehicles + 1):
        lane, accel = 1 + number % 2, 0.5 * number
        for frame in range(1, frames + 1):
            time = frame / 10
            rows.append(
                ngsim_row(
                    number,
                    frame,
                    key=key,
                    Total_Frames=frames,
                    Local_X=f"{LANE_FT * lane - 6 + 0.2 * time + 0.05 * number:.3f}",
                    Local_Y=f"{_drive(number, time):.3f}",
                    v_length=f"{14 + number / 10:.1f}",
                    v_Vel=f"{40 + accel * time:.2f}",
                    v_Acc=f"{accel:.2f}",
                    Lane_ID=lane,
                    Preceding=max(number - 2, 0),
                    Following=number + 2 if number + 2 <= vehicles else 0,
                    Space_Headway=f"{_drive(number - 2, time) - _drive(number, time):.2f}" if number > 2 else 0,
                    Time_Headway=f"{(_drive(number - 2, time) - _drive(number, time)) / (40 + accel * time):.2f}"
                    if number > 2
                    else 0,
                )
            )
    return rows


def _drive(number, time):
    return 1000 - 50 * number + 40 * time + 0.25 * number * time**2


def scale(rows, factor, columns=FEET_COLUMNS):
    """The rows with some columns in another unit."""
    return [row | {name: f"{float(row[name]) * factor:.8f}" for name in columns} for row in rows]


def reorder(*swaps):
    """NGSIM's 18 names with some pairs swapped."""
    names = list(TEXT_NAMES)
    for one, other in swaps:
        first, second = names.index(one), names.index(other)
        names[first], names[second] = other, one
    return names
