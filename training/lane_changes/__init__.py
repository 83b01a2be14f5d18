"""Lane changes predicted by a random forest, and cells of a grid around each vehicle (Choi et al. 2021).

`examples` finds maneuvers in the tracks' lanes, from the future, and draws samples evenly; `features` describes them;
`forest` fits and stores; `cells` divides the road around a vehicle; `scores` holds accuracies and the learning curve.

Source: Choi, Yim, Baek and Lee 2021, Machine Learning-Based Vehicle Trajectory Prediction Using V2V Communications and
On-Board Sensors, Electronics 10(4), 420, https://doi.org/10.3390/electronics10040420.
"""
