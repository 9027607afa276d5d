"""Comparison of a run with another, or with another team's results: differences / combined sigma, common errors."""
