"""Late starts of tracks, and estimates of the missing frames before them."""
