"""The study: models on recorded and generated traffic, with intervals of every difference."""
