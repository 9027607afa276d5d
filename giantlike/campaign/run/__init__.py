"""Running a campaign: loading images, the pool of worker processes, transfer of attitudes, the three steps."""

WORKER_MODULES = ("giantlike.campaign.run.worker", "astropy.io.fits")
"""Modules that worker processes find imported."""
