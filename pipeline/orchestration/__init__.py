"""The plan of a run, and the Prefect flows that carry it out."""
