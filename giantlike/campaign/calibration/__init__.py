"""Calibration of the camera within a campaign, from stars or boards."""
