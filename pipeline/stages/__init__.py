"""The stages: what each makes of a recording, planned from the manifest and free of any orchestrator."""
