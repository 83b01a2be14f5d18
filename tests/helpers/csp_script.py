"""What conv-social-pooling's preprocess_data.m and its Dataset class do, said again slowly and plainly.

Every number is a numpy single and every operation on them one of single precision, as in MATLAB.
"""

from fractions import Fraction

import numpy as np

S = np.float32
PARTS = ("train", "val", "eval")


def round_half_away(value):
    """MATLAB's round, of a number that is not negative, without rounding on the way."""
    return int(Fraction(float(value)) + Fraction(1, 2))


def run_script(recordings, folded=()):
    """The script on rows in the order of the files.

    Args:
        recordings: {data set id: [(Vehicle_ID, Frame_ID, Local_X, Local_Y, Lane_ID), ...]}, feet.
        folded: ids of the data sets of which lanes from 6 on are 6.

    Returns:
        {part: (traj rows of 47 singles each, {(data set id, vehicle): (3, T) singles})}, and how many vehicles of under
        31 frames were skipped, on which the script itself stops.
    """
    parts = {part: ([], {}) for part in PARTS}
    stopped_on = 0
    for dataset, rows in sorted(recordings.items()):
        rows = [tuple(S(value) for value in row) for row in rows]
        if dataset in folded:
            rows = [(*row[:4], S(6) if row[4] >= 6 else row[4]) for row in rows]
        columns = [parse(dataset, row, rows) for row in rows]
        highest = max(row[0] for row in rows)
        last_train, last_val = round_half_away(S(0.7) * highest), round_half_away(S(0.8) * highest)
        for vehicle in sorted({row[0] for row in rows}):
            part = PARTS[0] if vehicle <= last_train else PARTS[1] if vehicle <= last_val else PARTS[2]
            track = np.array([row[1:4] for row in rows if row[0] == vehicle], S).T
            parts[part][1][dataset, int(vehicle)] = track
        for row in columns:
            part = PARTS[0] if row[1] <= last_train else PARTS[1] if row[1] <= last_val else PARTS[2]
            frames = parts[part][1][dataset, int(row[1])][0]
            if len(frames) >= 31 and frames[30] <= row[2] and frames[-1] > row[2] + S(1):
                parts[part][0].append(row)
        stopped_on += sum(
            track.shape[1] < 31 for part in PARTS for (k, _), track in parts[part][1].items() if k == dataset
        )
    return parts, stopped_on


def parse(dataset, row, rows):
    """Labels and grid of one row: 'Parse fields'. Indices count from 1 where the script's do."""
    vehicle, time, _, y, lane = row
    own = [other for other in rows if other[0] == vehicle]
    index = 1 + [other[1] for other in own].index(time)

    last, first = min(len(own), index + 40), max(1, index - 40)
    before, now, after = own[first - 1][4], own[index - 1][4], own[last - 1][4]
    lateral = 3 if after > now or now > before else 2 if after < now or now < before else 1

    last, first = min(len(own), index + 50), max(1, index - 30)
    longitudinal = 1
    if last != index and first != index:
        with np.errstate(divide="ignore", invalid="ignore"):
            history = (own[index - 1][3] - own[first - 1][3]) / S(index - first)
            future = (own[last - 1][3] - own[index - 1][3]) / S(last - index)
            longitudinal = 2 if float(future / history) < 0.8 else 1

    grid = [S(0)] * 39
    for beside, offset in ((lane - 1, 1), (lane, 14), (lane + 1, 27)):
        for other in rows:
            if other[1] == time and other[4] == beside:
                dy = other[3] - y
                if abs(dy) < 90 and (offset != 14 or dy != 0):
                    grid[offset + round_half_away((dy + S(90)) / S(15)) - 1] = other[0]
    return [S(dataset), *row, S(lateral), S(longitudinal), *grid]


class ScriptDataset:
    """The indexing of the project's own Dataset class (ngsimDataset), without PyTorch."""

    def __init__(self, contents, history=30, horizon=50, stride=2):
        self.samples, self.tracks = contents["traj"], contents["tracks"]
        self.history, self.horizon, self.stride = history, horizon, stride

    def __len__(self):
        return len(self.samples)

    def __getitem__(self, index):
        """(history, future, 39 neighbors' histories, one-hot lateral, one-hot longitudinal)"""
        sample = self.samples[index]
        dataset, vehicle, frame = sample[0].astype(int), sample[1].astype(int), sample[2]
        around = [self.look_back(neighbor.astype(int), frame, vehicle, dataset) for neighbor in sample[8:]]
        lateral, longitudinal = np.zeros(3), np.zeros(2)
        lateral[int(sample[6] - 1)] = 1
        longitudinal[int(sample[7] - 1)] = 1
        own = self.look_back(vehicle, frame, vehicle, dataset)
        return own, self.look_ahead(vehicle, frame, dataset), around, lateral, longitudinal

    def look_back(self, vehicle, frame, reference, dataset):
        if vehicle == 0 or self.tracks.shape[1] <= vehicle - 1:
            return np.empty([0, 2])
        origin = self.tracks[dataset - 1][reference - 1].transpose()
        track = self.tracks[dataset - 1][vehicle - 1].transpose()
        origin = origin[np.where(origin[:, 0] == frame)][0, 1:3]
        if track.size == 0 or np.argwhere(track[:, 0] == frame).size == 0:
            return np.empty([0, 2])
        now = np.argwhere(track[:, 0] == frame).item()
        found = track[np.maximum(0, now - self.history) : now + 1 : self.stride, 1:3] - origin
        return found if len(found) == self.history // self.stride + 1 else np.empty([0, 2])

    def look_ahead(self, vehicle, frame, dataset):
        track = self.tracks[dataset - 1][vehicle - 1].transpose()
        now = np.argwhere(track[:, 0] == frame).item()
        end = np.minimum(len(track), now + self.horizon + 1)
        return track[now + self.stride : end : self.stride, 1:3] - track[now, 1:3]
