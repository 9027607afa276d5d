"""Running a campaign: loading images, the pool of worker processes, transfer of attitudes, the three steps."""

WORKER_MODULES = ("giantlike.campaign.run.server",)  # modules that worker processes find imported
