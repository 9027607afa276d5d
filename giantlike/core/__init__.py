"""Errors, outcomes, frames, units, time and checks for every layer; imports no other package of giantlike."""
