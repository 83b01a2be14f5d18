"""Raw recordings to lake: sources, transforms, the lake, stages, flows and the command line."""

from importlib.metadata import version

__version__ = version("tracklake")
