"""Prediction by an instrumented vehicle (the ego) of the vehicles around it, from its own log of a drive.

`samples` cuts histories and futures and splits them; `models` and `networks` predict positions, `maneuvers` lane
changes; `training` fits; `scores` and `collisions` judge; `feeds` compares what the ego perceives with the truth.
`overhead` makes such samples of overhead tracks, on which `as_published` compares the publication's method with ours.

Positions are relative to the ego AT THE SAME MOMENT, in its frame then: x ahead, y to the right of its centre, m. So
the ego is at (0, 0) throughout, two predicted cells overlap where they touch, and what the ego itself does during the
horizon is a part of the future.

Source: Choi, Yim, Baek and Lee 2021, Machine Learning-Based Vehicle Trajectory Prediction Using V2V Communications and
On-Board Sensors, Electronics 10(4), 420, https://doi.org/10.3390/electronics10040420.
"""
