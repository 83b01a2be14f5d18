"""A subset as floating-car data of SUMO, its road, and a configuration that replays it."""
