"""Raw files to tracks, vehicles and subsets: discovery, ingestion and removal."""
