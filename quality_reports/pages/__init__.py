"""The report's pages and documents."""
