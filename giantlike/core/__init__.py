"""Errors, outcomes, frames, units and time: what every layer speaks of. Imports nothing of ours."""
