"""Raw entries to the canonical frame: orientation, kinematics, gaps and vehicle identities."""
