"""Pages and documents of the report."""
