"""Running a campaign: loading images, the pool of worker processes, transfer of attitudes, the three steps."""
