"""``giantlike plan``: the plan file, the folder that a plan is written to, and a plan beside the run of its images."""
