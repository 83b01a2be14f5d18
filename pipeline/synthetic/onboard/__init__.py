"""The virtual instrumentation of a vehicle: what it would have logged in an overhead recording, in real formats."""
