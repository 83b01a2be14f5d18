"""Episodes of car following, one row per entry, ready for calibration."""
