"""The lake in the formats of other projects."""
