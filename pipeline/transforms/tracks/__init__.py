"""The canonical frame of tracks: orientation, kinematics, gaps and vehicle identities."""
