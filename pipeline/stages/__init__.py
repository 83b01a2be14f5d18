"""The declared stages after ingestion, and the planner that runs them without any orchestrator."""
