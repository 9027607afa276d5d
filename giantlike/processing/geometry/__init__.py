"""Solvers of geometry problems: Wahba's problem, perspective-n-point, conics through points."""
