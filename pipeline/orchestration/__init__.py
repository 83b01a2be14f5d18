"""What there is to do, and the Prefect flows that do it."""
