"""Exports of a lake to the formats of other projects."""
