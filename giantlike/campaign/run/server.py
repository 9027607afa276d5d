"""Imports of the server process from which worker processes are forked: all modules that they need."""

from importlib import import_module

from giantlike._system.processes import importing

with importing():
    for _module in ("giantlike.campaign.run.worker", "giantlike.campaign.run.pool", "astropy.io.fits"):
        import_module(_module)
