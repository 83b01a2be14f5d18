"""Raw recordings to a lake: sources, transforms, stages, flows and the command line."""
