"""What the server that worker processes are forked from imports: all that they need."""

from importlib import import_module

from giantlike.core.processes import importing

with importing():
    for _module in ("giantlike.campaign.run.worker", "giantlike.campaign.run.pool", "astropy.io.fits"):
        import_module(_module)
